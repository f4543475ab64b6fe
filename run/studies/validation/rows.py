"""The rows of the table of a validation."""

from __future__ import annotations

from typing import Any

Row = dict[str, Any]


def row(
    check: str,
    quantity: str,
    reference: float,
    found: float,
    source: str,
    unit: str,
    allowed: float,
    error: float | None = None,
) -> Row:
    """What is compared, with its standard error if it is a mean; `allowed` is the deviation that is fine, relative, or
    absolute where the reference is zero."""
    deviation = found - reference if reference == 0.0 else found / reference - 1.0
    return _row(check, quantity, reference, found, error, unit, deviation, abs(deviation) <= allowed, source)


def band(
    check: str, quantity: str, low: float, high: float, found: float, source: str, unit: str, error: float | None = None
) -> Row:
    """What is to lie in a published band, to two standard errors if it is a mean; the deviation is that from the nearer
    end of the band, relative, zero inside."""
    deviation = found / min(max(found, low), high) - 1.0
    spare = 2.0 * (error or 0.0)
    agrees = low - spare <= found <= high + spare
    return _row(check, quantity, [low, high], found, error, unit, deviation, agrees, source)


def above(check: str, quantity: str, low: float, found: float, error: float, source: str, unit: str) -> Row:
    """What is to lie above `low` by more than twice its standard error; the deviation is in standard errors."""
    deviation = (found - low) / error
    return _row(check, quantity, [low, None], found, error, unit, deviation, deviation > 2.0, source)


def _row(
    check: str,
    quantity: str,
    reference: float | list[float | None],
    found: float,
    error: float | None,
    unit: str,
    deviation: float,
    agrees: bool,
    source: str,
) -> Row:
    return {
        "check": check,
        "quantity": quantity,
        "reference": reference,
        "found": found,
        "error": error,
        "unit": unit,
        "deviation": deviation,
        "agrees": bool(agrees),
        "source": source,
    }
