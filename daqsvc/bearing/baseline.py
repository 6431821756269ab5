"""The healthy machine as its bearings' detectors remember it: what they compare with, from one recording.

On disk it is a TOML file that comes back to the last bit.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping  # noqa: TC003 - pydantic reads the annotations
from dataclasses import MISSING, asdict, dataclass, field, fields
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, get_type_hints

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from daqsvc import heap
from daqsvc.bearing.geometry import BearingOrders
from daqsvc.bearing.identify import (
    BANDS,
    HIGHEST,
    HealthyResidual,
    InnovationsModel,
    NotIdentifiableError,
    Whiteness,
    learn_healthy,
)
from daqsvc.bearing.impact import HealthySpectrum
from daqsvc.bearing.model import BearingParameters
from daqsvc.bearing.race.judge import race_baseline
from daqsvc.bearing.race.verdict import PARTS, BandLevels, PartEvidence, RaceBaseline
from daqsvc.bearing.sliding_mode import SlidingGains, UnitEnergies
from daqsvc.bearing.two_sensors import HealthyPair, learn_pair
from daqsvc.confined.small_toml import read_toml
from daqsvc.dsp.quality import UnfitError
from daqsvc.errors.detectors import CALIBRATION_FILE

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

    from daqsvc.bearing.race.verdict import Part
    from daqsvc.bearing.two_sensors import PairModel

    Floats: TypeAlias = NDArray[np.float64]


_RESAMPLED_HIGHEST = 0.4
"""Of the new rate: above, the filter of the resampling is not the recorder's."""
_MOST_RATIO = 1000


@dataclass(frozen=True, slots=True, kw_only=True)
class BearingBaseline:
    """A machine in good order.

    Attributes:
        rate_hz: sampling rate.
        speed_rpm: stated speed of the shaft.
        residuals: innovations of one accelerometer, or of several together, by their names.
        races: lines and levels of each bearing, by the name of its accelerometer.
        pairs: what accelerometers on rotor and housing show together, by their names in that order.
        units: in which it was learnt, by the names of the accelerometers; empty if not known.
        source: the recording it comes from.
        written: label of the date, ISO 8601; empty if not known.
    """

    rate_hz: float
    speed_rpm: float
    residuals: Mapping[tuple[str, ...], HealthyResidual]
    races: Mapping[str, RaceBaseline]
    pairs: Mapping[tuple[str, ...], HealthyPair] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    source: str = ""
    written: str = ""


def learn_baseline(
    samples: Mapping[str, Floats],
    rate_hz: float,
    speed_rpm: float,
    bearings: Mapping[str, BearingOrders],
    together: Sequence[tuple[str, ...]],
    *,
    pairs: Mapping[tuple[str, ...], PairModel] | None = None,
    units: Mapping[str, str] | None = None,
    highest: float = HIGHEST,
    source: str = "",
) -> BearingBaseline:
    """Learn the healthy machine.

    Args:
        samples: float64 ``[n]`` of each accelerometer, NaN where missing.
        rate_hz: sampling rate.
        speed_rpm: stated speed of the shaft.
        bearings: fault orders of the bearing at each accelerometer that has one.
        together: accelerometers whose innovations are modelled together.
        pairs: bearings with an accelerometer on rotor and housing, by the names of these in that order.
        units: of the samples, by the names of the accelerometers.
        highest: where the bands of the innovations end, as a part of the sampling rate.
        source: what the recording is called.

    Raises:
        NotIdentifiableError: the recording cannot be the healthy machine's; the message names the channels.
    """
    residuals: dict[tuple[str, ...], HealthyResidual] = {}
    races: dict[str, RaceBaseline] = {}
    healthy_pairs: dict[tuple[str, ...], HealthyPair] = {}
    names: tuple[str, ...] = ()
    try:
        for name, orders in bearings.items():
            names = (name,)
            heap.give_back()
            races[name] = race_baseline(samples[name], rate_hz, speed_rpm, orders)
        for names in together:
            columns = np.column_stack([samples[name] for name in names])
            heap.give_back()
            residuals[names] = learn_healthy(columns, rate_hz, highest=highest)
        for names, model in (pairs or {}).items():
            columns = np.column_stack([samples[name] for name in names]) * model.m_s2_per_unit
            healthy_pairs[names] = learn_pair(model.parameters, rate_hz, columns)
    except (NotIdentifiableError, UnfitError, ValueError) as error:
        raise NotIdentifiableError(f"{', '.join(names)}: {error}") from None
    heap.give_back()
    return BearingBaseline(
        rate_hz=rate_hz,
        speed_rpm=speed_rpm,
        residuals=residuals,
        races=races,
        pairs=healthy_pairs,
        units=units or {},
        source=source,
    )


def resampled(samples: Floats, rate_hz: float, to_hz: float) -> tuple[Floats, float]:
    """A faster recording at a slower rate, and where its bands must end then, as a part of that rate.

    Args:
        samples: float64 ``[n]``.
        rate_hz: its rate.
        to_hz: the rate that is wanted.

    Raises:
        NotIdentifiableError: it is slower than that, or there is no simple ratio between the two.
    """
    if to_hz == rate_hz:
        return samples, HIGHEST
    ratio = Fraction(to_hz / rate_hz).limit_denominator(_MOST_RATIO)
    if to_hz > rate_hz or abs(float(ratio) * rate_hz / to_hz - 1.0) > 1e-6:
        raise NotIdentifiableError(
            f"the healthy machine was sampled at {rate_hz:g} Hz and cannot be compared at {to_hz:g} Hz; "
            f"give a recording of it at {to_hz:g} Hz, or a whole multiple"
        )
    from scipy.signal import resample_poly  # noqa: PLC0415 - costs a second that few callers need

    return np.asarray(resample_poly(samples, ratio.numerator, ratio.denominator)), _RESAMPLED_HIGHEST


SCHEMA_VERSION = 1

_REMEDY = "restore the file, or calibrate again"
_PREAMBLE = """\
# A machine in good order, as its bearings' detectors remember it.
# [[residual]]: innovations model of one accelerometer, or of several together, and how large the innovations
# are, in dB, window by window: all bands together, then each.
# [[race]]: evidence for each part of a bearing although it was in good order; its fault orders.
# [[pair]]: cross-spectra of the residual of accelerometers on rotor and housing, with these masses (kg),
# springs (N/m) and dampers (N s/m). A line holds the power of either race's component, and their cross-power.
"""

Positive = Annotated[float, Field(gt=0)]


class BaselineFileError(ValueError):
    """A file with a healthy machine cannot be read, used or written; the message shows why and what to do."""

    code = CALIBRATION_FILE


class _FileTable(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class _ResidualTable(_FileTable):
    channels: Annotated[list[str], Field(min_length=1)]
    window_samples: Annotated[int, Field(ge=16)]
    windows: Annotated[int, Field(ge=2)]
    rms: list[Positive]
    edges_hz: Annotated[list[Positive], Field(min_length=BANDS + 1, max_length=BANDS + 1)]
    mean_db: Annotated[list[float], Field(min_length=BANDS + 1, max_length=BANDS + 1)]
    spread_db: Annotated[list[float], Field(min_length=BANDS + 1, max_length=BANDS + 1)]
    whiteness_p: Annotated[float, Field(ge=0, le=1)]
    predictable: Annotated[float, Field(ge=0, le=1)]
    covariance: list[list[float]]
    coefficients: list[list[list[float]]]

    def made(self, rate_hz: float) -> HealthyResidual:
        """The healthy machine of this table.

        Raises:
            ValueError: the shapes do not fit each other, or the covariance is none.
        """
        m = len(self.channels)
        covariance = np.array(self.covariance, dtype=np.float64)
        coefficients = np.array(self.coefficients, dtype=np.float64)
        if not self.coefficients:
            coefficients = np.zeros((0, m, m))
        if covariance.shape != (m, m) or coefficients.shape[1:] != (m, m) or len(self.rms) != m:
            raise ValueError(f"covariance, coefficients or rms are not those of {m} channels")
        if not (np.linalg.eigvalsh(covariance) > 0.0).all():
            raise ValueError("the covariance is not positive definite")
        white = Whiteness(self.whiteness_p, self.predictable)
        return HealthyResidual(
            model=InnovationsModel(coefficients, covariance, rate_hz, white),
            window_samples=self.window_samples,
            edges_hz=np.array(self.edges_hz),
            mean_db=np.array(self.mean_db),
            spread_db=np.array(self.spread_db),
            windows=self.windows,
            rms=np.array(self.rms),
        )


_part_fields: dict[str, Any] = {
    one.name: (get_type_hints(PartEvidence)[one.name], ... if one.default is MISSING else one.default)
    for one in fields(PartEvidence)
}
_Part = create_model("_Part", __base__=_FileTable, **_part_fields)
"""A table with the fields of `PartEvidence`, whatever these are."""


class _Orders(_FileTable):
    inner: float
    outer: float
    ball: float
    cage: float


class _Race(_FileTable):
    channel: str
    speed_rpm: Positive
    orders: _Orders | None = None
    edges_hz: Annotated[list[Positive], Field(min_length=2)]
    power: list[float]
    evidence: Mapping[Literal["inner", "outer", "ball"], _Part]

    def made(self) -> RaceBaseline:
        """The healthy bearing of this table.

        Raises:
            ValueError: a part or a band is missing, or the orders are not those of a bearing.
        """
        if set(self.evidence) != set(PARTS) or len(self.power) != len(self.edges_hz) - 1:
            raise ValueError("a part or a band is missing")
        evidence: dict[Part, PartEvidence] = {
            part: PartEvidence(**self.evidence[part].model_dump()) for part in PARTS
        }
        orders = None if self.orders is None else BearingOrders(**self.orders.model_dump())
        levels = BandLevels(tuple(self.edges_hz), tuple(self.power))
        return RaceBaseline(evidence, levels, self.speed_rpm, orders)


class _SpectrumTable(_FileTable):
    frames: Annotated[int, Field(ge=1)]
    lines: list[Annotated[list[float], Field(min_length=4, max_length=4)]]

    def made(self) -> HealthySpectrum:
        """The spectrum of this table.

        Raises:
            ValueError: a line is no covariance.
        """
        lines = np.array(self.lines, dtype=np.float64).reshape(-1, 4)
        covariance = np.empty((len(lines), 2, 2), dtype=np.complex128)
        covariance[:, 0, 0], covariance[:, 1, 1] = lines[:, 0], lines[:, 1]
        covariance[:, 0, 1] = lines[:, 2] + 1j * lines[:, 3]
        covariance[:, 1, 0] = covariance[:, 0, 1].conj()
        if not (np.linalg.eigvalsh(covariance) > 0.0).all():
            raise ValueError("a line of a cross-spectrum is not positive definite")
        return HealthySpectrum(covariance, self.frames)


class _Gains(_FileTable):
    inner: Positive
    outer: Positive
    leak: Positive


class _Energies(_FileTable):
    inner_unit: Positive
    outer_unit: Positive


class _Pair(_FileTable):
    channels: Annotated[list[str], Field(min_length=2, max_length=2)]
    parameters: Mapping[str, float]
    detection: _SpectrumTable
    isolation: _SpectrumTable
    gains: _Gains
    energies: _Energies

    def made(self, rate_hz: float) -> HealthyPair:
        """The healthy machine of this table.

        Raises:
            ValueError: the figures are not those of a bearing, or one is missing.
        """
        try:
            return HealthyPair(
                parameters=BearingParameters(**self.parameters),
                rate_hz=rate_hz,
                detection=self.detection.made(),
                isolation=self.isolation.made(),
                gains=SlidingGains(**self.gains.model_dump()),
                energies=UnitEnergies(**self.energies.model_dump()),
            )
        except TypeError as error:
            raise ValueError(f"pair of {', '.join(self.channels)}: a figure is missing: {error}") from None


class _File(_FileTable):
    schema_version: Literal[1]
    kind: Literal["bearing"]
    written: str = ""
    source: str = ""
    rate_hz: Positive
    speed_rpm: Positive
    units: Mapping[str, str] = {}
    residual: Annotated[list[_ResidualTable], Field(min_length=1)]
    race: list[_Race] = []
    pair: list[_Pair] = []


def load_bearing_baseline(path: Path | str) -> BearingBaseline:
    """Read a machine in good order.

    Raises:
        BaselineFileError: the file cannot be read or used; the message names file, key, value and remedy.
    """
    try:
        document = read_toml(Path(path))
        _refuse_rotor(document, path)
        table = _File.model_validate(document)
        return BearingBaseline(
            rate_hz=table.rate_hz,
            speed_rpm=table.speed_rpm,
            residuals={tuple(one.channels): one.made(table.rate_hz) for one in table.residual},
            races={one.channel: one.made() for one in table.race},
            pairs={tuple(one.channels): one.made(table.rate_hz) for one in table.pair},
            units=table.units,
            source=table.source,
            written=table.written,
        )
    except OSError as error:
        raise BaselineFileError(
            f"{path}: {error.strerror}; name a file that daqsvc calibrate wrote for a bearing"
        ) from None
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(map(str, first["loc"]))
        why = first["msg"].removeprefix("Value error, ").lower()
        raise BaselineFileError(f"{path}: {key} = {_short(first['input'])}: {why}; {_REMEDY}") from None
    except BaselineFileError:
        raise
    except (ValueError, RecursionError) as error:
        raise BaselineFileError(f"{path}: {error}; {_REMEDY}") from None


def _refuse_rotor(document: Mapping[str, Any], path: Path | str) -> None:
    if "rotor" in document and "kind" not in document:
        raise BaselineFileError(
            f"{path}: was written of a rotor, for pipeline.rotor_synchronous.calibration or --calibration "
            "with --probes, and bearings are watched here; calibrate them"
        )


def save_bearing_baseline(baseline: BearingBaseline, path: Path | str) -> None:
    """Write a machine in good order; a file of that name is replaced as a whole, or not at all.

    Raises:
        BaselineFileError: the file cannot be written.
    """
    path = Path(path)
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        try:
            beside.write_text("\n".join(_lines(baseline)) + "\n", encoding="utf-8")
            beside.replace(path)
        finally:
            beside.unlink(missing_ok=True)
    except OSError as error:
        raise BaselineFileError(
            f"{path}: cannot be written: {error.strerror}; name a file in a directory that can be"
        ) from None


def _lines(baseline: BearingBaseline) -> Iterator[str]:
    yield f"{_PREAMBLE}schema_version = {SCHEMA_VERSION}"
    yield 'kind = "bearing"'
    if baseline.written:
        yield f"written = {_value(baseline.written)}"
    yield f"source = {_value(baseline.source)}"
    yield f"rate_hz = {_value(float(baseline.rate_hz))}"
    yield f"speed_rpm = {_value(float(baseline.speed_rpm))}"
    if baseline.units:
        units = ", ".join(f"{_value(name)} = {_value(unit)}" for name, unit in baseline.units.items())
        yield f"units = {{ {units} }}"
    for channels, residual in baseline.residuals.items():
        yield "\n[[residual]]"
        yield f"channels = {_value(list(channels))}"
        yield f"window_samples = {residual.window_samples}"
        yield f"windows = {residual.windows}"
        for key in ("rms", "edges_hz", "mean_db", "spread_db"):
            yield f"{key} = {_value(getattr(residual, key).tolist())}"
        yield f"whiteness_p = {_value(residual.model.whiteness.p_value)}"
        yield f"predictable = {_value(residual.model.whiteness.predictable)}"
        yield f"covariance = {_value(residual.model.covariance.tolist())}"
        rows = ",\n    ".join(_value(row) for row in residual.model.coefficients.tolist())
        yield f"# of order {residual.model.order}, a matrix for each sample back"
        yield f"coefficients = [\n    {rows},\n]" if rows else "coefficients = []"
    for channel, race in baseline.races.items():
        yield "\n[[race]]"
        yield f"channel = {_value(channel)}"
        yield f"speed_rpm = {_value(float(race.speed_rpm))}"
        if race.orders is not None:
            orders = ", ".join(f"{name} = {_value(value)}" for name, value in asdict(race.orders).items())
            yield f"orders = {{ {orders} }}"
        yield f"edges_hz = {_value([float(edge) for edge in race.levels.edges_hz])}"
        yield f"power = {_value([float(power) for power in race.levels.power])}"
        for part, evidence in race.evidence.items():
            pairs = ", ".join(f"{key} = {_value(value)}" for key, value in asdict(evidence).items())
            yield f"evidence.{part} = {{ {pairs} }}"
    for channels, pair in baseline.pairs.items():
        yield "\n[[pair]]"
        yield f"channels = {_value(list(channels))}"
        for key in ("parameters", "gains", "energies"):
            figures = ", ".join(
                f"{name} = {_value(value)}" for name, value in asdict(getattr(pair, key)).items()
            )
            yield f"{key} = {{ {figures} }}"
        yield from _spectrum_lines("detection", pair.detection)
        yield from _spectrum_lines("isolation", pair.isolation)


def _spectrum_lines(key: str, spectrum: HealthySpectrum) -> Iterator[str]:
    S = spectrum.covariance
    lines = np.column_stack((S[:, 0, 0].real, S[:, 1, 1].real, S[:, 0, 1].real, S[:, 0, 1].imag))
    rows = "".join(f"\n    {_value(line)}," for line in lines.tolist())
    yield f"{key}.frames = {spectrum.frames}"
    yield f"{key}.lines = [{rows}\n]"


def _value(value: Any) -> str:
    """A TOML value: JSON's texts, numbers, booleans and arrays are TOML's, but for one control character."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, str):
        value = value.encode("utf-8", "replace").decode()
    return json.dumps(value, allow_nan=False).replace("\x7f", "\\u007f")


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
