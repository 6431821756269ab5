"""Three bearings to design and test with; the paper's own figures are in a reference that was not found."""

from __future__ import annotations

from daqsvc.bearing.model import BearingParameters

S1 = BearingParameters(
    m_r=4.0, m_b=0.0185, m_h=2.0, k_s=2e7, k_c=1e8, k_h=5e7, c_s=200.0, c_c=300.0, c_h=2000.0
)
"""A deep-groove ball bearing like a 6205: its balls are light, so that the two races look nearly alike."""

S2 = BearingParameters(
    m_r=2.0, m_b=0.0185, m_h=0.5, k_s=4e7, k_c=1e8, k_h=5e7, c_s=100.0, c_c=50.4718, c_h=2638.981
)
"""With `S2_EIGENVALUE`, has the directions (1, 2) and (1, 6) that the paper found for inner and outer."""
S2_EIGENVALUE = -1.0

S3 = BearingParameters(
    m_r=2.0,
    m_b=1.0,
    m_h=2.0,
    k_s=1.7765e8,
    k_c=3.5531e8,
    k_h=1.7765e8,
    c_s=753.98,
    c_c=2513.27,
    c_h=1256.64,
)
"""Heavy rolling elements: their mode is at 4.2 kHz, so that the two races can be told apart by direction."""
S3_EIGENVALUE = -125.66
