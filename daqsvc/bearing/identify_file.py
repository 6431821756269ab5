"""A machine in good order on disk: a TOML file that comes back to the last bit."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping  # noqa: TC003 - pydantic reads the annotations
from dataclasses import MISSING, asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, create_model

from daqsvc.bearing.identify import InnovationsModel, Whiteness
from daqsvc.bearing.identify_baseline import BearingBaseline
from daqsvc.bearing.identify_change import BANDS, HealthyResidual
from daqsvc.bearing.impact import HealthySpectrum
from daqsvc.bearing.model import BearingParameters
from daqsvc.bearing.race.baseline import BandLevels, RaceBaseline
from daqsvc.bearing.race.verdict import PARTS, PartEvidence
from daqsvc.bearing.sliding_mode import SlidingGains, UnitEnergies
from daqsvc.bearing.two_sensors import HealthyPair
from daqsvc.confined.small_toml import read_toml

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from daqsvc.bearing.race.verdict import Part

    Floats = NDArray[np.float64]

SCHEMA_VERSION = 1

_REMEDY = "restore the file, or calibrate again"
_PREAMBLE = """\
# A machine in good order, as its bearings' detectors remember it.
# [[residual]]: innovations model of one accelerometer, or of several together, and how large the innovations
# are, in dB, window by window: all bands together, then each.
# [[race]]: what spoke for each part of a bearing although it was in good order.
# [[pair]]: cross-spectra of the residual of accelerometers on rotor and housing, with these masses (kg),
# springs (N/m) and dampers (N s/m). A line holds the power of either race's component, and their cross-power.
"""

Positive = Annotated[float, Field(gt=0)]


class BaselineFileError(ValueError):
    """A file with a healthy machine cannot be read, used or written; the message says why and what to do."""


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


class _Race(_FileTable):
    channel: str
    speed_rpm: Positive
    edges_hz: Annotated[list[Positive], Field(min_length=2)]
    power: list[float]
    evidence: Mapping[Literal["inner", "outer", "ball"], _Part]

    def made(self) -> RaceBaseline:
        """The healthy bearing of this table.

        Raises:
            ValueError: a part or a band is missing.
        """
        if set(self.evidence) != set(PARTS) or len(self.power) != len(self.edges_hz) - 1:
            raise ValueError("a part or a band is missing")
        evidence: dict[Part, PartEvidence] = {
            part: PartEvidence(**self.evidence[part].model_dump()) for part in PARTS
        }
        return RaceBaseline(evidence, BandLevels(tuple(self.edges_hz), tuple(self.power)), self.speed_rpm)


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
    residual: Annotated[list[_ResidualTable], Field(min_length=1)]
    race: list[_Race] = []
    pair: list[_Pair] = []


def load_bearing_baseline(path: Path | str) -> BearingBaseline:
    """Read a machine in good order.

    Raises:
        BaselineFileError: the file cannot be read or used; the message names file, key, value and remedy.
    """
    try:
        table = _File.model_validate(read_toml(Path(path)))
        return BearingBaseline(
            rate_hz=table.rate_hz,
            speed_rpm=table.speed_rpm,
            residuals={tuple(one.channels): one.made(table.rate_hz) for one in table.residual},
            races={one.channel: one.made() for one in table.race},
            pairs={tuple(one.channels): one.made(table.rate_hz) for one in table.pair},
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
    except (ValueError, RecursionError) as error:
        raise BaselineFileError(f"{path}: {error}; {_REMEDY}") from None


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
