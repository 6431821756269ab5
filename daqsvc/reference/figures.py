"""The figures in ``statistics`` of a diagnosis, by detector."""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
from typing import TYPE_CHECKING, NamedTuple, get_args

from daqsvc.detectors.bearing.settings import BEARING
from daqsvc.detectors.rotor_bank.settings import ROTOR_BANK
from daqsvc.detectors.rotor_synchronous.settings import ROTOR_SYNCHRONOUS
from daqsvc.reference.markdown import anchored, code, table
from daqsvc.settings.measures import Measure

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Mapping

LEVELS = "levels/SENSOR"


class Figure(NamedTuple):
    """A figure: its unit, empty for a pure number, and what it is."""

    unit: str
    about: str


_OF_SENSOR = "of the sensor"
_PER_REVOLUTION = "the same per revolution of the shaft"
_LINE_AMPLITUDE = "root mean square radius of its motion"
FIGURES: Mapping[str, Mapping[str, Figure]] = {
    LEVELS: {
        "mean": Figure(_OF_SENSOR, "mean of the window"),
        "rms": Figure(_OF_SENSOR, "root mean square about the mean"),
        "peak": Figure(_OF_SENSOR, "largest distance from the mean"),
        "peak_to_peak": Figure(_OF_SENSOR, "largest value less the smallest"),
        "crest_factor": Figure("", "`peak` over `rms`"),
        "gap_voltage": Figure("V", "mean gap voltage of a proximity probe, where `gap_ok_v` is in the file"),
        "velocity_rms": Figure(
            "mm/s", "RMS velocity in `velocity_band_hz`, of an accelerometer or a velocity sensor"
        ),
        "velocity_rms_2_1000": Figure("mm/s", "RMS velocity from 2 to 1000 Hz, where it is asked for"),
        "kurtosis": Figure("", "kurtosis of the samples, where it is asked for"),
        "1x_amplitude": Figure(_OF_SENSOR, "amplitude at the speed of the shaft, where it is asked for"),
        "1x_phase_lag": Figure("deg", "phase lag of it behind the keyphasor"),
        "2x_amplitude": Figure(_OF_SENSOR, "amplitude at twice the speed, where it is asked for"),
        "2x_phase_lag": Figure("deg", "phase lag of it behind the keyphasor"),
        "not_1x_rms": Figure(
            _OF_SENSOR, "RMS of what is not at the speed of the shaft, where it is asked for"
        ),
        "not_1x_peak_to_peak": Figure(_OF_SENSOR, "the same, peak to peak"),
        "value": Figure(_OF_SENSOR, "a level that the device has measured itself; it has no other figure"),
    },
    ROTOR_BANK: {
        "speed": Figure("rpm", "speed of the shaft"),
        "paper.MODE": Figure("", "conditional probability of the mode, as the paper defines it"),
        "misfit": Figure(
            "", "part of a steady change that the declared mode does not explain, with two modes"
        ),
        "line.frequency": Figure(
            "Hz", "of a line that is at no harmonic of the shaft and none of the rotor's, and is left out"
        ),
        "line.order": Figure("", _PER_REVOLUTION),
        "line.amplitude": Figure("um", _LINE_AMPLITUDE),
    },
    ROTOR_SYNCHRONOUS: {
        "speed": Figure("rpm", "speed of the shaft in the last revolution"),
        "1x.amplitude": Figure("um", "amplitude of the forward 1X vector"),
        "1x.phase": Figure("deg", "its phase, from the mark of the keyphasor"),
        "mean.x": Figure("um", "mean position of the shaft"),
        "mean.y": Figure("um", "the same, in the other direction"),
        "noise": Figure("um", "noise of one probe, from the calibration"),
        "calibration.revolutions": Figure("", "revolutions that the baseline was made of"),
        "departure": Figure("nat", "how far the synchronous vectors are from the baseline"),
        "departure.energy": Figure("nat", "the same of what does not repeat with the shaft"),
        "severity": Figure("", "size of the change over the amplitude of the healthy whirl"),
        "line.frequency": Figure(
            "Hz", "of a line that came with the change and is at no harmonic of the shaft, if one stands out"
        ),
        "line.order": Figure("", _PER_REVOLUTION),
        "line.amplitude": Figure("um", _LINE_AMPLITUDE),
        "FAULT.ratio": Figure("", "`unbalance`: 1X vector after over before the change"),
        "FAULT.change_um": Figure(
            "um",
            "`unbalance`: change of the 1X vector; `unmodelled`, `small_change`: of all synchronous vectors",
        ),
        "FAULT.change_deg": Figure("deg", "`unbalance`: direction of the change, from the mark"),
        "FAULT.eccentricity_change_um": Figure("um", "`unbalance`: change of the eccentricity that makes it"),
        "FAULT.damping_ratio": Figure("", "`damping_loss`: damping ratio that is left"),
        "FAULT.least": Figure("", "`damping_loss`: least that the tolerances of the rotor allow"),
        "FAULT.most": Figure("", "`damping_loss`: most that they allow"),
        "FAULT.left": Figure("", "`damping_loss`: what is left, as a part of the healthy damping"),
        "FAULT.shift_um": Figure("um", "`static_load`: shift of the mean position"),
        "FAULT.shift_deg": Figure("deg", "`static_load`: direction of the shift"),
        "FAULT.of_sag": Figure("", "`static_load`: the shift over the sag of the shaft"),
        "FAULT.stiffness": Figure("", "`stiffness_loss`: what is left, as a part of the healthy stiffness"),
        "FAULT.backward_1x_um": Figure("um", "`rub`: change of the backward 1X vector"),
        "FAULT.force_um": Figure(
            "um", "`rub`: contact force in a revolution over the stiffness of the shaft"
        ),
        "FAULT.contact_deg": Figure("deg", "`rub`: angle of the shaft where it touches"),
        "FAULT.nonsynchronous_um": Figure(
            "um",
            "`unmodelled`, `small_change`: RMS of what does not repeat with the shaft, above the healthy one",
        ),
    },
    BEARING: {
        "speed": Figure("rpm", "speed of the shaft, as the lines of the bearing show it"),
        "line.frequency": Figure("Hz", "frequency of the first line of the named part"),
        "line.order": Figure("", "the same as a multiple of the speed"),
        "BEARING.PART.z": Figure("", "significance of the lines of `inner`, `outer` or `ball`"),
        "BEARING.PART.size": Figure("", "their size: modulation of the whitened envelope"),
        "BEARING.PART.severity": Figure("", "`z` times `size`"),
        "BEARING.direction": Figure(
            "dB", "two sensors: energy of the inner race over that of the outer race"
        ),
        "BEARING.direction.change": Figure(
            "nat", "two sensors: logarithm of the likelihood ratio of a fault"
        ),
        "BEARING.direction.bursts": Figure(
            "", "two sensors: scatter of the energy over that of steady noise"
        ),
        "residual.ratio": Figure("", "RMS innovations over those of the healthy machine"),
        "residual.rise": Figure("dB", "the same as a level"),
        "residual.departure": Figure("", "largest rise of a band over its limit; changed from 1 on"),
    },
}
"""By detector; words in capitals are names."""

_HELD_IN = {"statistics", "figures", "level"}
"""Variables in which the functions of `_makers` collect figures."""


def _makers() -> Mapping[str, tuple[tuple[str, Callable[..., object]], ...]]:
    """By detector the functions that make its figures, each with what their names begin with."""
    from daqsvc.detectors.bearing.evaluation import figures_of  # noqa: PLC0415 - these bring SciPy
    from daqsvc.detectors.levels.detector import LevelDetector  # noqa: PLC0415
    from daqsvc.detectors.rotor_bank.statements import BankDiagnosisBuilder  # noqa: PLC0415
    from daqsvc.detectors.rotor_synchronous.statements import Stater  # noqa: PLC0415
    from daqsvc.rotor.synchronous import severity  # noqa: PLC0415
    from daqsvc.rotor.synchronous.nonsynchronous import NonsynchronousLine  # noqa: PLC0415

    sizes = [
        one
        for _, one in inspect.getmembers(severity, inspect.isfunction)
        if one.__module__ == severity.__name__
    ]
    return {
        LEVELS: (("", LevelDetector._measure),),  # noqa: SLF001 - its text is read, nothing is called
        ROTOR_BANK: (("", BankDiagnosisBuilder.state), ("", NonsynchronousLine.figures)),
        ROTOR_SYNCHRONOUS: (
            ("", Stater._statistics),  # noqa: SLF001
            ("", NonsynchronousLine.figures),
            *(("FAULT.", one) for one in sizes),
        ),
        BEARING: (("", figures_of),),
    }


def gaps() -> Iterator[str]:
    """Figures that nothing describes, and those that are described but made nowhere."""
    made = {name: {*_made(makers)} for name, makers in _makers().items()}
    made[LEVELS] |= {*get_args(Measure)}
    for detector, figures in made.items():
        described = {_shape(name): name for name in FIGURES[detector]}
        for figure in sorted(figures - {*described}):
            yield f"figure {figure} of {detector} is described nowhere: daqsvc.reference.figures"
        for shape in sorted({*described} - figures):
            yield f"figure {described[shape]} of {detector} is made nowhere: daqsvc.reference.figures"


def _shape(name: str) -> str:
    """A figure with a star for each name in it."""
    return re.sub(r"\b[A-Z]+\b", "*", name)


def _made(makers: Iterable[tuple[str, Callable[..., object]]]) -> Iterator[str]:
    """The names of figures in the text of functions, a star for what is not known before they run."""
    for prefix, maker in makers:
        known = inspect.unwrap(maker).__globals__
        for key in _keys(ast.parse(textwrap.dedent(inspect.getsource(maker)))):
            match key:
                case ast.Constant(value=str() as name):
                    yield _shape(prefix) + name
                case ast.JoinedStr(values=parts):
                    names = (part.value if isinstance(part, ast.Constant) else "*" for part in parts)
                    yield _shape(prefix) + "".join(map(str, names))
                case ast.Name(id=name) if isinstance(known.get(name), str):
                    yield _shape(prefix) + known[name]


def _keys(function: ast.AST) -> Iterator[ast.expr]:
    """The keys under which a function writes figures: into a variable that holds them, or what it returns."""
    for node in ast.walk(function):
        match node:
            case ast.Assign(targets=[ast.Name(id=name)], value=value) if name in _HELD_IN:
                yield from _keys_of(value)
            case ast.AugAssign(target=ast.Name(id=name), value=value) if name in _HELD_IN:
                yield from _keys_of(value)
            case ast.Assign(targets=[ast.Subscript(value=ast.Name(id=name), slice=key)]) if name in _HELD_IN:
                yield key
            case ast.Return(value=ast.Dict() as value):
                yield from _keys_of(value)


def _keys_of(value: ast.expr) -> Iterator[ast.expr]:
    match value:
        case ast.Dict(keys=keys):
            yield from filter(None, keys)
        case ast.DictComp(key=key):
            yield key


def section() -> str:
    """The figures of each detector, as a part of a page."""
    rows = [
        (
            f'<a id="figure-{detector.partition("/")[0]}.{name}"></a>{code(name)}',
            code(detector),
            one.unit,
            one.about,
        )
        for detector, figures in FIGURES.items()
        for name, one in figures.items()
    ]
    return "\n\n".join(
        [
            anchored("## Figures in `statistics`", "figures"),
            _ABOUT,
            table(("figure", "detector", "unit", "what"), rows),
        ]
    )


_ABOUT = """What `statistics` of `daqsvc.diagnosis/1` and `cause.statistics` of `daqsvc.alarm/1` hold, by
detector. Words in capitals are names: a sensor, a mode of the rotor bank, a bearing and its part, a fault of
the group. A figure is left out where it is not known. A detector of another package has its own figures."""
