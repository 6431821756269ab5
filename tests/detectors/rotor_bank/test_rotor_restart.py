"""A device that counts from 0 again: how many samples are missing is a guess, and so is the shaft's angle."""

from __future__ import annotations

import asyncio

import numpy as np
import pytest
from support.rotor_runs import damping_bank
from support.shaft_channels import channels_of

from daqsvc.acquisition.assembler import StreamAssembler
from daqsvc.acquisition.ring import RingReader, SampleRing
from daqsvc.acquisition.samples import Quality, SampleBlock
from daqsvc.detectors.rotor_bank.detector import KeyphasorProbe, Probe
from daqsvc.detectors.rotor_synchronous.revolutions import RevolutionStream
from sim_hw.plants import rotor as plant

PER_REV = 64
RATE_HZ = 640.0
PER_FRAME = 4
FRAME_NS = round(PER_FRAME / RATE_HZ * 1e9)
NOISE_UM = 5.0
RESET_REV = 20
PROBES = (Probe("probe-x", 0, 0.0), Probe("probe-y", 1, 90.0))
KEYPHASOR = KeyphasorProbe("keyphasor", 2, -6.0)
LATE_REV = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9]
"""How late the first frames after the reset come, in revolutions: so far off is where they are placed."""


def bank():
    return damping_bank(RATE_HZ, NOISE_UM)


def blocks_of(samples, late_rev):
    """Blocks of a device that counts anew from `RESET_REV` on, without a pause; its frames are late then."""
    blocks: list[SampleBlock] = []
    unit = StreamAssembler(
        "shaft",
        RATE_HZ,
        counter_bits=16,
        samples_per_frame=PER_FRAME,
        counts_per_frame=1,
        deliver=blocks.append,
    )
    frames = samples[: len(samples) // PER_FRAME * PER_FRAME].reshape(-1, PER_FRAME, samples.shape[1])
    number = np.arange(len(frames))
    reset = RESET_REV * PER_REV // PER_FRAME
    arrival_ns = 10**9 + number * FRAME_NS
    late = (number >= reset) & (number < reset + 50)
    arrival_ns += np.where(late, round(late_rev * PER_REV / RATE_HZ * 1e9), 0)
    arrival_ns = np.maximum.accumulate(arrival_ns)
    counter = np.where(number < reset, 9000 + number, number - reset)
    for at in range(len(frames)):
        some = slice(at, at + 1)
        unit.accept(counter[some], frames[some], np.ones(1, np.bool_), arrival_ns[some])
    unit.flush()
    return blocks


def windows_of(blocks, block):
    """What a reader of the ring gets, a window for each few blocks."""

    async def main():
        ring = SampleRing("shaft", ("x", "y", "keyphasor"), 4096)
        reader, windows = RingReader(ring), []
        for one in blocks:
            ring.write(one)
            while reader.behind >= block:
                windows.append(await reader.read(block, 8))
        return windows

    return asyncio.run(main())


@pytest.fixture(scope="module")
def worn():
    """A rotor that loses damping five revolutions after the device has begun to count anew."""
    steps = [plant.Change(RESET_REV + 5.0, plant.PlantParameters(damping_ratio=0.10))]
    motion = plant.simulate(plant.PlantParameters(), steps, revolutions=45.0, samples_per_rev=PER_REV)
    return channels_of(motion, NOISE_UM)


@pytest.mark.parametrize("late_rev", LATE_REV)
def test_what_a_guessed_gap_does_to_the_angle_is_no_fault_of_the_rotor(worn, late_rev):
    blocks = blocks_of(worn, late_rev)
    (broken,) = [one for one in blocks if one.quality & Quality.PLACE_ESTIMATED]
    off = (broken.first_index - blocks[0].first_index) - (RESET_REV * PER_REV + PER_FRAME)
    assert off / PER_REV == pytest.approx(late_rev, abs=0.1)
    subject, detector_block = bank(), bank().block
    said = [one for window in windows_of(blocks, detector_block) for one in subject.process(window)]
    assert [one.decision for one in said if one.changed] == ["N", "F1"]
    # Nor is the fault that comes some revolutions later found any later.
    found = next(one for one in said if one.decision == "F1")
    onset = blocks[0].first_index + off + (RESET_REV + 5) * PER_REV
    assert 0.0 < (found.end_index - onset) / PER_REV < 3.0
    # The shaft turns as fast as before.
    assert {round(one.statistics["speed"] / 600.0, 2) for one in said[3:]} == {1.0}


def test_a_break_before_the_first_sample_of_a_window_comes_with_it(worn):
    blocks = blocks_of(worn, 0.5)
    (broken,) = [one.first_index for one in blocks if one.quality & Quality.PLACE_ESTIMATED]
    for block in (1, 16, 48):
        windows = windows_of(blocks, block)
        (carrier,) = [window for window in windows if window.breaks]
        assert carrier.breaks == (broken,)
        parts = carrier.parts()
        assert [part.breaks for part in parts if part.breaks] == [(broken,)]
        assert next(part for part in parts if part.breaks).first_index == broken
        assert np.array_equal(
            np.concatenate([part.samples for part in parts]), carrier.samples, equal_nan=True
        )
        assert parts[-1].t_end_ns == carrier.t_end_ns


def test_a_reader_that_was_too_slow_learns_of_the_break_it_has_missed(worn):
    async def main():
        ring = SampleRing("shaft", ("x", "y", "keyphasor"), 128)
        reader, blocks = RingReader(ring), blocks_of(worn, 0.5)
        ring.write(blocks[0])
        await reader.read(2, 1)
        for one in blocks[1:]:
            ring.write(one)
        return await reader.read(16, 8)

    window = asyncio.run(main())
    assert window.skipped > 0
    assert window.breaks == (window.first_index,)


def test_no_revolution_is_cut_across_a_guessed_gap(worn):
    blocks = blocks_of(worn, 0.5)
    turns = RevolutionStream(
        machine="rig", rate_hz=RATE_HZ, speed_rpm=600.0, probes=PROBES, reference=KEYPHASOR
    )
    lengths = []
    for window in windows_of(blocks, 16):
        for part in window.parts():
            revolutions = turns.process(part.samples, part.first_index, broken=bool(part.breaks))
            lengths += [len(revolution.raw) for revolution in revolutions]
    assert len(lengths) >= 38
    assert set(lengths) <= {PER_REV - 1, PER_REV, PER_REV + 1}
