"""What an output brings to the service, registered as an entry point in the group ``daqsvc.outputs``."""

from __future__ import annotations

from types import MappingProxyType
from typing import TYPE_CHECKING, ClassVar, TypeVar

from daqsvc.settings.hooks import contract, may_raise
from daqsvc.settings.plugins import OutputTable
from daqsvc.settings.problems import AssemblyError
from daqsvc.settings.section import Section

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from daqsvc.publish.output import Output, OutputPort
    from daqsvc.settings.models import MachineFile

SettingsT = TypeVar("SettingsT", bound=Section)


@contract
class OutputPlugin(OutputTable[SettingsT]):
    """A kind of output: its table in the machine file, and what makes the output of it.

    Importing one must be cheap: what takes time is imported when the output is made.

    Attributes:
        status_key: where its figures are in the status; empty for nowhere.
        outdated: by how the names of its conditions begin, the message for those of an earlier run once the
            machine file has no such table any more.
    """

    status_key: ClassVar[str] = ""
    outdated: ClassVar[Mapping[str, str]] = MappingProxyType({})

    def conditions(self, settings: SettingsT) -> Iterable[str]:
        """Names of all that `Output.conditions` may report, so that people may prepare for it."""
        del settings
        return ()

    @may_raise(AssemblyError)
    def build(self, machine: MachineFile, settings: SettingsT, port: OutputPort) -> Output | None:
        """The output; None for one that another output takes with it. Making it opens nothing.

        Args:
            machine: the machine file.
            settings: the table.
            port: what it works with.

        Raises:
            AssemblyError: what the table names cannot be used.
        """
        raise NotImplementedError
