"""A verdict in a very long record: `python -m tests.benchmarks.long_record [--rows 1500000]`.

A pendulum with dry friction, in 15 episodes with 0.006 rad and 0.02 rad/s of noise; the simulator has none.
"""

import argparse
import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import yaml

from tests.benchmarks.cost import searched

EPISODES, DT, FINE = 15, 0.05, 10
NOISE = {"phi": 0.006, "omega": 0.02}


def record(rows: int) -> pd.DataFrame:
    """Simulate, in ten steps of Runge and Kutta a row."""
    random = np.random.default_rng(0)
    length = rows // EPISODES
    u = np.repeat(random.uniform(-2, 2, (EPISODES, -(-length // 10))), 10, axis=1)[:, :length]

    def rates(x: Any, u: Any) -> Any:
        phi, omega = x.T
        return jnp.stack([omega, 9.81 * jnp.sin(phi) + u - 0.8 * jnp.tanh(omega / 0.02)], axis=1)

    def row(x: Any, u: Any) -> tuple[Any, Any]:
        def step(x: Any, _: None) -> tuple[Any, None]:
            h = DT / FINE
            a = rates(x, u)
            b = rates(x + h / 2 * a, u)
            c = rates(x + h / 2 * b, u)
            return x + h / 6 * (a + 2 * b + 2 * c + rates(x + h * c, u)), None

        return jax.lax.scan(step, x, None, length=FINE)[0], x

    with jax.enable_x64(True):
        start = jnp.tile(jnp.array([3.1, 0.0]), (EPISODES, 1))
        x = np.asarray(jax.jit(lambda u: jax.lax.scan(row, start, u)[1])(u.T)).transpose(1, 0, 2)
    noisy = x + np.array(list(NOISE.values())) * random.normal(size=x.shape)
    columns = {"episode": np.repeat(np.arange(EPISODES), length), "t": np.tile(np.arange(length) * DT, EPISODES)}
    columns |= {"phi": np.angle(np.exp(1j * noisy[..., 0])).ravel(), "omega": noisy[..., 1].ravel(), "u": u.ravel()}
    return pd.DataFrame(columns)


def main() -> None:
    """Simulate, search and print."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.long_record", description=__doc__)
    parser.add_argument("--rows", type=int, default=1_500_000)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        record(options.rows).to_parquet(folder / "long.parquet")
        data = {
            "path": str(folder / "long.parquet"),
            "time": "t",
            "episode": "episode",
            "columns": {},
            "noise_std": NOISE,
        }
        (folder / "data").mkdir()
        (folder / "data" / "long.yaml").write_text(yaml.safe_dump(data | {"n_train": None}))
        words = ["--config-dir", str(folder), "sim=pendulum", "data=long", "close=false"]
        found = searched(words, folder / "run")
    print(found["summary"])
    print(f"{options.rows} rows: {found['seconds']:.0f} s, {found['cost']['memory_mib']:.0f} MiB")


if __name__ == "__main__":
    main()
