"""What the records of a run show: filtered series, means of the steady part, the friction angle."""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil

import numpy as np

from dem.arrays import Bools, Floats


def low_pass(time: Floats, values: Floats, cutoff: float) -> Floats:
    """Return values (n,) at equally spaced times (n,) [s], without their parts of higher frequency than `cutoff` [Hz].

    Butterworth filter of second order, forwards and backwards, so that nothing is shifted in time. The series goes on
    beyond its ends, mirrored at the end points, for as long as the filter remembers. The values come back unchanged if
    they last no longer than that, 1 / `cutoff`, or if they do not resolve the cutoff.
    """
    if len(values) < 3:
        return values.copy()
    from scipy import signal  # here, as its import would slow down every start

    rate = 1.0 / float(np.median(np.diff(time)))
    memory = ceil(rate / cutoff)
    if cutoff >= 0.5 * rate or len(values) <= memory:
        return values.copy()
    sections = signal.butter(2, cutoff, fs=rate, output="sos")
    return signal.sosfiltfilt(sections, values, padlen=memory)


def filtered(records: Mapping[str, Floats], names: list[str], cutoff: float) -> dict[str, Floats]:
    """Return the named records through `low_pass`, under the names "force_filtered [N]" and the like."""
    out = {}
    for name in names:
        stem, bracket, unit = name.partition(" [")
        out[f"{stem}_filtered{bracket}{unit}"] = low_pass(records["time [s]"], records[name], cutoff)
    return out


def calm(records: Mapping[str, Floats]) -> Bools:
    """Return the mask (n,) of the steps without a jump of energy (`dem.record.energy_balance`): means are of these."""
    return records["energy_jump [J]"] == 0.0


def friction_angle(shear: Floats, normal: Floats) -> float:
    """Return the angle [degrees] whose tangent is the mean shear over the mean normal stress."""
    return float(np.degrees(np.arctan2(np.mean(shear), np.mean(normal))))
