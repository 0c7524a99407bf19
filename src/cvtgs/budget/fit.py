"""Rates from measurements: non-negative least squares."""

from collections.abc import Mapping, Sequence

import numpy as np

LEAST = 2e-3
"""Seconds below which a difference does not count."""


def fit_rates(rows: Sequence[Mapping[str, float]], seconds: Sequence[float]) -> dict[str, float]:
    """Find what each feature costs, so that the sum comes close to what was measured.

    Non-negative least squares (Lawson and Hanson 1974) of relative errors: no rate is negative,
    so no prediction for more work is below one for less.
    """
    from scipy.optimize import nnls  # noqa: PLC0415 (heavy, and only for a calibration)

    names = list(rows[0])
    amounts = np.array([[row[name] for name in names] for row in rows], dtype=np.float64)
    measured = np.array(seconds, dtype=np.float64)
    weights = 1 / np.maximum(measured, LEAST)
    scales = np.maximum(amounts.max(axis=0), 1e-300)
    rates, _ = nnls(amounts / scales * weights[:, None], measured * weights)
    return {
        name: float(rate / scale) for name, rate, scale in zip(names, rates, scales, strict=True)
    }
