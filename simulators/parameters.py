"""Draws from the prior p(phi) that the parameters of a simulator declare."""

import numpy as np

from simulators.model import Quantity


def draw(params: tuple[Quantity, ...], rng: np.random.Generator, n: int) -> np.ndarray:
    """Draw n parameter vectors, (n, dp), each entry in the unit of its quantity.

    Args:
        params: `prior` says the law. uniform: on the range. normal, lognormal: the range is the interval of +-2
            standard deviations (lognormal: of the logarithm), and nothing is cut off at its ends.
        rng: source of randomness.
        n: number of draws.

    """
    columns = [_column(quantity, rng, n) for quantity in params]
    return np.column_stack(columns) if columns else np.zeros((n, 0))


def _column(quantity: Quantity, rng: np.random.Generator, n: int) -> np.ndarray:
    low, high = quantity.low, quantity.high
    match quantity.prior:
        case "uniform":
            return rng.uniform(low, high, n)
        case "normal":
            return rng.normal((low + high) / 2, (high - low) / 4, n)
        case "lognormal":
            low, high = np.log(low), np.log(high)
            return np.exp(rng.normal((low + high) / 2, (high - low) / 4, n))
        case other:
            raise ValueError(f"{quantity.name}: {other!r} is no prior; allowed: uniform, normal, lognormal")
