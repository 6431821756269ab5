"""From a recording of accelerometers and what is known about the bearings to a verdict.

`analyse_bearings` is a pure function: it reads nothing but its arguments and keeps nothing. The tests inside
are those that watch the machine live.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from daqsvc.analysis.bearing_checks import (
    accelerometer_quality,
    ball_order_problem,
    refuse_no_machine,
    with_repairs,
)
from daqsvc.analysis.bearing_inputs import meant_in_hz, stated_speed_problem, unit_problems
from daqsvc.analysis.bearing_result import BearingAnalysis
from daqsvc.analysis.many import Outcome
from daqsvc.analysis.quality import DataQuality
from daqsvc.bearing.identify import NotIdentifiableError
from daqsvc.bearing.identify_change import compare_residual
from daqsvc.bearing.race.judge import race_test
from daqsvc.detectors.bearing.finding import find
from daqsvc.dsp.quality import UnfitError
from daqsvc.dsp.quality.clipped import ClippedError, refuse_clipped
from daqsvc.recording.errors import RecordingError

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from daqsvc.analysis.bearing_inputs import HealthyRun
    from daqsvc.analysis.bearing_setup import BearingSetup
    from daqsvc.bearing.identify_baseline import BearingBaseline
    from daqsvc.bearing.identify_change import HealthyResidual, ResidualChange
    from daqsvc.bearing.race.verdict import RaceVerdict
    from daqsvc.recording.recording import Recording

    Floats = NDArray[np.float64]


def analyse_bearings(
    recording: Recording, setup: BearingSetup, baseline: BearingBaseline | None = None
) -> BearingAnalysis:
    """Say which bearing of a machine is damaged, and where.

    Args:
        recording: to be judged.
        setup: what is known.
        baseline: the healthy machine at the recording's rate, learnt by the same setup.
    """
    samples = np.where(np.isfinite(recording.samples), recording.samples, np.nan)
    quality = _quality(recording, setup)
    source = None if baseline is None else baseline.source
    races: dict[str, RaceVerdict] = {}
    unfit: dict[str, str] = {}
    for name, column in zip(recording.names, samples.T, strict=True):
        before = None if baseline is None else baseline.races[name]
        try:
            refuse_clipped(column)
            race = race_test(
                column, recording.rate_hz, setup.speed_rpm, setup.bearings[name], setup.race, before
            )
            refuse_no_machine(column, setup.unit, race)
        except ClippedError as error:
            unfit[name] = str(error)
            quality = replace(quality, clipped={**quality.clipped, name: error.samples})
        except UnfitError as error:
            unfit[name] = str(error)
        else:
            races[name] = race

    def refuse(why: str) -> BearingAnalysis:
        return BearingAnalysis(
            recording=str(recording.source),
            baseline=source,
            setup=setup,
            quality=quality,
            refused=why,
            unfit=unfit,
        )

    if not any(race.speed_seen for race in races.values()) and (wrong := meant_in_hz(recording, setup)):
        return refuse(wrong)
    if not races:
        return refuse("; ".join(f"{name}: {why}" for name, why in unfit.items()))
    healthy = None if baseline is None else baseline.residuals[tuple(races)]
    change: ResidualChange | None = None
    if healthy is not None:
        try:
            change = _change(healthy, samples, recording, setup, tuple(races))
        except ValueError as error:
            return refuse(str(error))
    return BearingAnalysis(
        recording=str(recording.source),
        baseline=source,
        setup=setup,
        quality=with_repairs(quality, races),
        finding=find(races, change, setup.change.false_alarm_probability),
        races=races,
        unfit=unfit,
        healthy=healthy,
        change=change,
    )


def _quality(recording: Recording, setup: BearingSetup) -> DataQuality:
    """What is known against a recording before it is judged."""
    quality = accelerometer_quality(recording.names, recording.samples, setup.unit)
    quality = replace(quality, problems=(*recording.notes, *quality.problems))
    orders = dict.fromkeys(ball_order_problem(setup.bearings[name]) for name in recording.names)
    speed = stated_speed_problem(recording, setup.speed_rpm)
    for problem in (speed, *unit_problems(recording, setup.unit), *orders):
        quality = quality.with_problem(problem) if problem else quality
    return quality


def _change(
    healthy: HealthyResidual,
    samples: Floats,
    recording: Recording,
    setup: BearingSetup,
    names: tuple[str, ...],
) -> ResidualChange:
    """How the innovations of the channels differ from the healthy machine's.

    Raises:
        ValueError: they cannot be compared, or what differs is no matter of the machine.
    """
    columns = samples[:, [recording.names.index(name) for name in names]]
    change = compare_residual(healthy, healthy.levels_db(columns), setup.change)
    if change.quiet:
        raise ValueError(
            f"{', '.join(names)}: {-change.rise_db[0]:.1f} dB quieter than in the healthy run: the machine "
            "stands still, a sensor is loose, or the unit is another; give recordings at one speed and unit"
        )
    if change.gain:
        raise ValueError(
            f"{', '.join(names)}: {change.rise_db[0]:.1f} dB louder than in the healthy run in all bands "
            f"alike (a factor of {change.ratio:.3g}): gain or unit is another; give both in one unit"
        )
    return change


@dataclass(frozen=True, slots=True)
class BearingAnalyst:
    """Judges recordings of one machine's bearings.

    Attributes:
        setup: what is known.
        healthy: the healthy run; None if there is none.
    """

    setup: BearingSetup
    healthy: HealthyRun | None = None

    def judge(
        self, recording: str, figures: str | None, progress: Callable[[int, int], None] | None = None
    ) -> Outcome:
        """See `daqsvc.analysis.many.Analyst.judge`."""
        del progress  # a recording takes a tenth of a second
        try:
            loaded = self.setup.load(recording)
        except RecordingError as error:
            analysis = BearingAnalysis(
                recording=recording,
                baseline=None if self.healthy is None else str(self.healthy.recording.source),
                setup=self.setup,
                quality=DataQuality(0),
                refused=str(error),
            )
        else:
            analysis = self._analyse(loaded)
            if figures is not None and analysis.races:
                from daqsvc.analysis.bearing_plots import draw_envelopes  # noqa: PLC0415 - brings matplotlib

                draw_envelopes(analysis, figures)
        return Outcome(analysis.as_json(), analysis.describe(), analysis.refused is not None)

    def _analyse(self, recording: Recording) -> BearingAnalysis:
        """Judge against the healthy run, unless that is none: it must not hide anything."""
        if self.healthy is None:
            return analyse_bearings(recording, self.setup)
        source = self.healthy.recording.source
        damage, doubt = self.healthy.against
        if damage:
            alone = analyse_bearings(recording, self.setup)
            return alone.with_problem(
                f"the healthy run {source} is not used: {damage}; give one of the machine in good order"
            )
        try:
            baseline = self.healthy.at(recording.rate_hz)
        except NotIdentifiableError as error:
            alone = analyse_bearings(recording, self.setup)
            return alone.with_problem(f"the healthy run {source} is not used: {error}")
        analysis = analyse_bearings(recording, self.setup, baseline)
        if not doubt:
            return analysis
        if analysis.leading is not None and analysis.leading.speed_seen:
            alone = analyse_bearings(recording, self.setup)
            return alone.with_problem(
                f"the healthy run {source} is not used: {doubt}, as those of the recording do; correct "
                "--baseline-fs, or give one at this speed"
            )
        return analysis.with_problem(
            f"the healthy run {source}: {doubt}; see whether its rate and speed are right"
        )
