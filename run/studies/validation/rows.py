"""The rows of the table of a validation: what is compared, with its standard error if it is a mean."""

from __future__ import annotations

from typing import Any

Row = dict[str, Any]


def row(
    check: str, quantity: str, reference: float, found: float, source: str, unit: str, allowed: float,
    error: float | None = None,
) -> Row:  # fmt: skip
    """`allowed` is the deviation that is fine, relative, or absolute where the reference is zero."""
    off = found - reference if reference == 0.0 else found / reference - 1.0
    return _row(check, quantity, reference, found, source, unit, error, off, abs(off) <= allowed)


def band(
    check: str, quantity: str, low: float, high: float, found: float, source: str, unit: str, error: float | None = None
) -> Row:
    """What is to lie in a published band, to two standard errors if it is a mean; the deviation is that from the nearer
    end of the band, relative, zero inside."""
    off, spare = found / min(max(found, low), high) - 1.0, 2.0 * (error or 0.0)
    return _row(check, quantity, [low, high], found, source, unit, error, off, low - spare <= found <= high + spare)


def above(check: str, quantity: str, low: float, found: float, error: float, source: str, unit: str) -> Row:
    """What is to lie above `low` by more than twice its standard error; the deviation is in standard errors."""
    off = (found - low) / error
    return _row(check, quantity, [low, None], found, source, unit, error, off, off > 2.0)


def _row(
    check: str, quantity: str, reference: float | list[float | None], found: float, source: str, unit: str,
    error: float | None, deviation: float, agrees: bool,
) -> Row:  # fmt: skip
    row: Row = {"check": check, "quantity": quantity, "reference": reference, "found": found, "error": error}
    return row | {"unit": unit, "deviation": deviation, "agrees": bool(agrees), "source": source}
