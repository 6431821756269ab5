"""What a detector brings to the service, registered as an entry point in the group ``daqsvc.detectors``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple, TypeVar

from daqsvc.errors.command_line import ARGUMENTS
from daqsvc.settings.hooks import contract, may_raise
from daqsvc.settings.plugins import PipelineTable
from daqsvc.settings.problems import AssemblyError
from daqsvc.settings.section import Section

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from daqsvc.diagnosis.detector import Detector
    from daqsvc.diagnosis.reading import Reading
    from daqsvc.diagnosis.recorded import RecordedDetector, RecordingOptions
    from daqsvc.settings.models import MachineFile

SettingsT = TypeVar("SettingsT", bound=Section)


class DetectabilityOptions(NamedTuple):
    """What ``daqsvc detectability`` gets beside the machine file; None: nothing.

    Attributes:
        process_noise: random motion of the machine itself, as power spectral density, normalised.
        noise_um: noise of one probe.
        eccentricity_um: mass eccentricity.
    """

    process_noise: float | None = None
    noise_um: float | None = None
    eccentricity_um: float | None = None


class Detectability(NamedTuple):
    """What a detector can see of a machine.

    Attributes:
        json: the figures, as one JSON object.
        text: the same for a person.
    """

    json: dict[str, Any]
    text: str


class UnfitOptionError(ValueError):
    """An option has no meaning for this detector; the message states what to do."""

    code = ARGUMENTS


@contract
class DetectorPlugin(PipelineTable[SettingsT]):
    """A kind of detector: its table in ``[pipeline]``, and what makes the detectors of it.

    Importing one must be cheap: what brings kernels is imported when a detector is made.

    Attributes:
        calibrated: whether ``daqsvc calibrate`` makes a file that ``calibration`` of its table can name.
        predictable: whether `detectability` is implemented.
    """

    calibrated: ClassVar[bool] = False
    predictable: ClassVar[bool] = False

    @may_raise(AssemblyError)
    def build(self, machine: MachineFile, settings: SettingsT, store: Path | None) -> Iterable[Detector]:
        """The detectors that the table asks for.

        Args:
            machine: the machine file.
            settings: the table.
            store: directory of the state that survives restarts; None to begin without any and leave none.

        Raises:
            AssemblyError: a file that the table names cannot be used, or its figures cannot go together.
        """
        raise NotImplementedError

    def faults(self, machine: MachineFile, settings: SettingsT) -> Mapping[str, Mapping[str, str]]:
        """By detector and decision the fault that it means, e.g. ``"damping_loss"``, for who shows it.

        Unless overridden nothing: a decision that is not named here is the fault's own name.

        Args:
            machine: the machine file.
            settings: the table.
        """
        del machine, settings
        return {}

    def change_setpoints(
        self, machine: MachineFile, settings: SettingsT, running: Iterable[Detector]
    ) -> None:
        """Have detectors judge by the setpoints of a machine file that was read again; they know the rest.

        Unless overridden nothing: only those that look at setpoints themselves need it.

        Args:
            machine: the machine file, in which nothing but alarms is different.
            settings: the table.
            running: all detectors of the machine, those of others too; each may be at work in its thread.
        """
        del machine, settings, running

    @may_raise(AssemblyError)
    def check_files(self, machine: MachineFile, settings: SettingsT) -> None:
        """See whether what the table names beside the machine file can be used.

        Raises:
            AssemblyError: it cannot; the message names file, key, value and remedy.
        """

    @may_raise(AssemblyError, ValueError)
    def recorded(
        self, machine: MachineFile, settings: SettingsT, options: RecordingOptions
    ) -> RecordedDetector[Any]:
        """The detector for recordings: what ``daqsvc analyze`` shows of it.

        Args:
            machine: the machine file.
            settings: the table.
            options: what is stated of the recordings.

        Returns:
            Unless overridden, one that condenses what the detectors of `build` state.

        Raises:
            ValueError: what the table or the options name cannot be used; the message states what to do.
        """
        from daqsvc.diagnosis.recorded import RecordedLive  # noqa: PLC0415 - NumPy, which `check` need not

        return RecordedLive(machine, settings, options, self.build)

    @may_raise(AssemblyError, ValueError)
    def detectability(
        self, machine: MachineFile, settings: SettingsT, options: DetectabilityOptions
    ) -> Detectability:
        """What the detector can tell apart, how soon and from which change on: ``daqsvc detectability``.

        Args:
            machine: the machine file.
            settings: the table.
            options: what is stated beside it.

        Raises:
            UnfitOptionError: an option has no meaning here.
            AssemblyError: no detector can be made of the table.
            ValueError: something is not known, or cannot be used; the message states what to do.
        """
        raise NotImplementedError

    def readings(self, machine: MachineFile, settings: SettingsT) -> Iterable[Reading]:
        """The figures that are shown by themselves."""
        del machine, settings
        return ()

    def quality_alarms(self, machine: MachineFile, settings: SettingsT) -> Iterable[str]:
        """Names of the alarms about what its detectors rest on: ``detector-ok`` from these is enough."""
        del machine, settings
        return () if self.detector is None else (f"detector-ok/{self.detector}",)
