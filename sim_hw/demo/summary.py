"""What a run of the demo comes to: onsets, declarations, delays, losses."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from sim_hw.node_faults import NodeFaults

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sim_hw.demo.session import DemoOutcome, Script
    from sim_hw.scenario import Onset

ROTOR_BANK = "rotor-bank"


def summarise(script: Script, outcome: DemoOutcome, *, speed: float) -> dict[str, Any]:
    """The summary as one JSON object.

    A declaration is a change of the decision of the script's detector. Its delay counts from the onset of the
    mode, in revolutions. It is wrong if the machine was in another mode. Samples at the end that do not fill
    a frame are left over: a device would send them with the next ones.
    """
    declared = [
        (str(payload["decision"]), int(payload["window"]["end_index"]))
        for payload in outcome.diagnoses
        if payload["detector"] == script.detector
    ]
    figures = outcome.figures
    stream = figures["streams"][script.stream]
    frames_lost = stream["samples_lost"] // max(outcome.samples_sent // max(outcome.frames_in, 1), 1)
    return {
        "type": "summary",
        "title": script.title,
        "seed": script.seed,
        "speed": speed,
        "simulated_s": script.duration_s,
        "real_s": outcome.real_s,
        "declared": [mode for mode, _ in declared],
        "onsets": _onsets(script, declared),
        "wrong_declarations": sum(not _true_at(script.onsets, mode, at) for mode, at in declared)
        if script.onsets
        else 0,
        "samples": {
            "sent": outcome.samples_sent,
            "left_over": len(script.samples) - outcome.samples_sent,
            "received": stream["samples_received"],
            "lost": stream["samples_lost"],
            "skipped_by_detectors": sum(d["samples_skipped"] for d in figures["detectors"].values()),
        },
        "frames": {
            "sent": outcome.frames_sent,
            "received": stream["frames_received"],
            "injected": outcome.injected,
            "counted": {
                "dropped": frames_lost - stream["frames_corrupt"],
                "duplicated": stream["frames_duplicate"],
                "reordered": stream["frames_reordered"],
                "corrupted": stream["frames_corrupt"],
            },
            "not_sent": _not_sent(script),
            "late": stream["frames_late"],
            "rejected": stream["frames_rejected"],
        },
        "clock": {"drift_ppm": stream["drift_ppm"], "jitter_ms": stream["jitter_ms"]},
        "loop_lag_ms": figures["loop_lag_ms"],
        "alarm_events": outcome.alarms,
        "messages": outcome.messages,
        "complete": outcome.complete,
    }


def _not_sent(script: Script) -> list[str]:
    """When the device sends nothing, in words: frames that it would have sent count as lost, too."""
    if not isinstance(script.faults, NodeFaults):
        return []  # none, or a link's only
    seconds = {
        what: sum(min(window.end_s, script.duration_s) - window.start_s for window in windows)
        for what, windows in (("silence", script.faults.silence), ("brown-out", script.faults.brown_out))
    }
    return [f"{length:g} s of {what}" for what, length in seconds.items() if length > 0.0]


def _onsets(script: Script, declared: Sequence[tuple[str, int]]) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = []
    per_rev = script.samples_per_rev or 1.0
    for i, onset in enumerate(script.onsets):
        end = script.onsets[i + 1].sample if i + 1 < len(script.onsets) else len(script.samples)
        at = next((at for mode, at in declared if mode == onset.mode and onset.sample <= at <= end), None)
        rows.append(
            {
                "mode": onset.mode,
                "onset_rev": onset.at_rev,
                "declared_rev": None if at is None else at / per_rev,
                "delay_rev": None if at is None else (at - onset.sample) / per_rev,
            }
        )
    return rows


def _true_at(onsets: Sequence[Onset], mode: str, sample: int) -> bool:
    true = onsets[0].mode
    for onset in onsets:
        if onset.sample <= sample:
            true = onset.mode
    return mode == true
