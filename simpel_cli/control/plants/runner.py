"""Runs a policy that simpel trained. Needs numpy and safetensors only; copy this file with policy.json and policy.safetensors.

runner = PolicyRunner("policy")
command = runner.command({"phi": 3.1, "omega": 0.0})     # every dt seconds; a dict of commands in physical units
runner.reset()                                           # at the start of every episode

A command whose `between_rows` is held is applied at once and kept until the next; one that is linear is reached dt later, along
a straight line.

As a program it reads a JSON object of states per line and answers with one of commands, or with {"error": ...} where the line
is none; an empty line starts a new episode:

    python run_policy.py < states.jsonl
"""

import json
import sys
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file


class PolicyRunner:
    """A deterministic policy with its memory of past commands.

    Args:
        folder: with policy.json and policy.safetensors.
    """

    def __init__(self, folder: str | Path) -> None:
        self.facts = json.loads((Path(folder) / "policy.json").read_text())
        arrays = load_file(Path(folder) / "policy.safetensors")
        self.mean, self.std = arrays["mean"], arrays["std"]
        count = sum(name.startswith("kernel_") for name in arrays)
        self.layers = [(arrays[f"kernel_{i}"], arrays[f"bias_{i}"]) for i in range(count)]
        self.low = np.array([c["low"] for c in self.facts["commands"]])
        self.high = np.array([c["high"] for c in self.facts["commands"]])
        self.past: list[np.ndarray] = []
        self.reset()

    def reset(self) -> None:
        """Forget the commands of an earlier episode."""
        rest = np.clip(np.zeros(len(self.low)), self.low, self.high)
        self.past = [rest] * self.facts["past_commands"]

    def observe(self, state: dict[str, float]) -> np.ndarray:
        """Return what the network sees of measured states, given by name in their units."""
        seen: list[float] = []
        for quantity in self.facts["states"]:
            value = float(state[quantity["name"]])
            seen += [np.sin(value), np.cos(value)] if quantity["angle"] else [value]
        return np.concatenate([np.array(seen), *self.past])

    def command(self, state: dict[str, float]) -> dict[str, float]:
        """Return the commands of this step, within their limits, and remember them.

        Raises:
            ValueError: a state is not finite; nothing is remembered.
        """
        x = (self.observe(state) - self.mean) / self.std
        if not np.isfinite(x).all():
            raise ValueError(f"a state is not finite: {state}")
        for i, (kernel, bias) in enumerate(self.layers):
            x = x @ kernel + bias
            if i < len(self.layers) - 1:
                x = np.maximum(x, 0.0)
        action = np.tanh(x[: len(self.low)])
        value = np.clip(self.low + (self.high - self.low) * (action + 1) / 2, self.low, self.high)
        if self.past:
            self.past = [*self.past[1:], value]
        return {c["name"]: float(v) for c, v in zip(self.facts["commands"], value, strict=True)}


def main() -> None:
    """Answer states on standard input with commands on standard output."""
    runner = PolicyRunner(Path(__file__).parent)
    for line in sys.stdin:
        if not line.strip():
            runner.reset()
            continue
        answer: dict[str, float] | dict[str, str]
        try:
            answer = runner.command(json.loads(line))
        except (KeyError, TypeError, ValueError) as error:  # the rig goes on; nothing was remembered of this line
            needed = ", ".join(f"{q['name']} [{q['unit']}]" for q in runner.facts["states"])
            answer = {
                "error": f"needed is a JSON object with finite numbers for {needed}; got {line.strip()} ({error})"
            }
        sys.stdout.write(json.dumps(answer) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
