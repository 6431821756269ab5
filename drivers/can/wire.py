"""How much of a CAN bus a frame takes: an estimate from its bits (ISO 11898-1); and how much is too much."""

from __future__ import annotations

from typing import NamedTuple

CLASSIC_MAX_LENGTH = 8

_TAIL_BITS = 13
"""CRC delimiter, ACK slot, ACK delimiter, end of frame (7) and intermission (3)."""


class FrameTime(NamedTuple):
    """Time of a frame on the wire in s: without stuff bits, and with as many as there can be."""

    least_s: float
    most_s: float


def frame_time(length: int, *, extended: bool, bitrate: int, data_bitrate: int | None = None) -> FrameTime:
    """Time that one data frame takes on the wire, intermission included.

    Args:
        length: payload bytes; more than 8 makes it a CAN FD frame.
        extended: whether the id has 29 bits rather than 11.
        bitrate: nominal bit/s.
        data_bitrate: bit/s of the data phase of a CAN FD frame; None if it does not switch.
    """
    if length <= CLASSIC_MAX_LENGTH:
        # SOF, id, RTR, IDE, r0, DLC (extended: SRR, 18 more id bits and r1 as well), data, CRC.
        stuffed = (39 if extended else 19) + 8 * length + 15
        total = stuffed + _TAIL_BITS
        return FrameTime(total / bitrate, (total + _most_stuff_bits(stuffed)) / bitrate)
    data_rate = data_bitrate or bitrate
    # SOF, id, RRS, IDE, FDF, res, BRS (extended: SRR and 18 more id bits as well).
    arbitration = 36 if extended else 17
    payload = 1 + 4 + 8 * length  # ESI, DLC, data
    crc = 17 if length <= 16 else 21
    fixed_stuff = 1 + -(-crc // 4)  # before the stuff count, then after every 4 bits of it and of the CRC
    # The rate switches back at the CRC delimiter, which is counted with the data phase.
    data = payload + 4 + crc + fixed_stuff + 1
    least_s = (arbitration + _TAIL_BITS - 1) / bitrate + data / data_rate
    stuff_s = _most_stuff_bits(arbitration) / bitrate + (payload // 4) / data_rate
    return FrameTime(least_s, least_s + stuff_s)


def _most_stuff_bits(bits: int) -> int:
    """Stuff bits in the worst sequence of ``bits`` bits: one after the first five, then after every four."""
    return (bits - 1) // 4
