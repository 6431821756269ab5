"""Two recordings of accelerometers without a keyphasor: have the orders of the shaft changed?"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from daqsvc.dsp.orders import order_vectors
from daqsvc.dsp.speed.lines import ORDERS
from daqsvc.rotor.orders import compare_orders
from make_pictures.style import BLACK, FAULTY, HEALTHY, new

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import NDArray

RATE_HZ, SECONDS, SPEED_RPM = 2000.0, 4.0, 1800.0
AXES = ("x", "y")
AMPLITUDES_MG = ((20.0, 14.0), (6.0, 5.0), (3.0, 3.0))
"""Of 1X, 2X and 3X on either axis."""
NOISE_MG = 15.0
GROWTH = 1.8
"""Of 1X, by more unbalance."""


def recording(seed: int, growth: float) -> NDArray[np.float64]:
    """Accelerations of a housing in mg, float64 ``[n, 2]``; where the shaft's angle begins is by chance."""
    random = np.random.default_rng(seed)
    turn = 2.0 * np.pi * (SPEED_RPM / 60.0 * np.arange(int(SECONDS * RATE_HZ)) / RATE_HZ + random.uniform())
    samples = random.normal(0.0, NOISE_MG, (len(turn), len(AXES)))
    for order, sizes in zip(ORDERS, AMPLITUDES_MG, strict=True):
        for axis, size in enumerate(sizes):
            samples[:, axis] += size * (growth if order == 1 else 1.0) * np.cos(order * turn + axis + order)
    return samples


def picture() -> Figure:
    """Amplitudes of the orders, healthy and now, with their uncertainty, and what is stated."""
    healthy, unchanged, faulty = (
        order_vectors(recording(seed, growth), RATE_HZ, SPEED_RPM, AXES)
        for seed, growth in ((1, 1.0), (2, 1.0), (3, GROWTH))
    )
    figure = new(2.9)
    places = np.arange(len(ORDERS) * len(AXES))
    labels = [f"{order}X {axis}" for order in ORDERS for axis in AXES]
    panels = figure.subplots(1, 2, sharey=True)
    for axes, now, color, title in zip(
        panels,
        (unchanged, faulty),
        (HEALTHY, FAULTY),
        ("healthy", f"faulty: 1X times {GROWTH:g}"),
        strict=True,
    ):
        change = compare_orders(healthy, now)
        axes.bar(places - 0.2, change.healthy.ravel(), 0.38, color="#c3cdd6", label="healthy run")
        axes.bar(places + 0.2, change.present.ravel(), 0.38, color=color, label="now")
        spread = 2.0 * change.present_uncertainty.ravel()
        axes.errorbar(
            places + 0.2, change.present.ravel(), spread, fmt="none", ecolor=BLACK, capsize=2, linewidth=1
        )
        words = " or ".join(name.replace("_", " ") for name in change.group)
        axes.set_title(title, color=color)
        axes.set_xticks(places, labels, fontsize=8)
        axes.set_ylim(0.0, 45.0)
        axes.grid(visible=False, axis="x")
        text = f"stated: {words}\ndeparture {change.departure:.1f} nats of {change.departure_threshold:.1f}"
        axes.text(0.98, 0.68, text, transform=axes.transAxes, ha="right", fontsize=9)
        axes.legend(loc="upper right", ncols=2)
    panels[0].set_ylabel("amplitude, mg")
    return figure
