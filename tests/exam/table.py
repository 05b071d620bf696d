"""The table of an exam: every figure of the design's bar table, for the tool and its rivals, with intervals.

Reference: Clopper and Pearson (1934), The use of confidence or fiducial limits, 95 %.
"""

import json
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import beta

from tests.exam.draw import CLOSED, FULL, NOISE, POSITION, SHAKEN
from tests.exam.plants import SYSTEMS
from tests.exam.score import CLEAR, ERROR, FALSE, HEDGED, NOTHING, PART, RIGHT, TIE, TWIN, UNEXPLAINED, WRONG

QUIET = 0.01  # noise up to which names must be exact
DEFAULT = 10**-0.5  # strengths above are a catalogue's usual ones: the upper half decade
HARMLESS = 1.02  # of the error before
WITHIN = 0.05  # of the share under full measurement
EQUAL = (POSITION, CLOSED, SHAKEN)  # conditions that the bar asks this of
TOLD_LEAST = 0.8  # of the sets with a nuisance of which it is said what it is
SLOWEST = 10.0  # s, two states
TOLD = ("simpel", "PySINDy", "BIC")
COLUMN = {"simpel": "outcome", "PySINDy": "pysindy", "BIC": "bic"}
OUTCOMES = (RIGHT, TIE, TWIN, PART, WRONG, HEDGED, NOTHING, UNEXPLAINED, FALSE, ERROR)


ABOUT = """Shares with their 95 % intervals. A search's seconds include the compilation of its process's first set;
`memory_mb` is the most that the process had so far, over all its sets. PySINDy's threshold is tuned per rig and noise on other
sets with strong effects; a twin counts as right for the rivals. Neither can name what acts on a sensor."""


class Bar(NamedTuple):
    """A figure: of which sets, which outcomes count, and the bar that it is held against."""

    figure: str
    bar: str
    of: Callable[[pd.DataFrame], pd.Series]
    counts: tuple[str, ...]
    least: float = 0.0
    most: float = 1.0


def _planted(t: pd.DataFrame) -> pd.Series:
    return t.kind.isin(["one", "two"]) & (t.evidence >= CLEAR)


def _single(t: pd.DataFrame) -> pd.Series:
    return (t.kind == "one") & (t.evidence >= CLEAR)


def _at(noise: float) -> Callable[[pd.DataFrame], pd.Series]:
    return lambda t: np.isclose(t.noise, noise)


def _per_noise(noise: float) -> tuple[Bar, Bar]:
    at = _at(noise)
    return (
        Bar(f"- named exactly at {100 * noise:g} % noise, oracle >= 10 nats", "", lambda t: _single(t) & at(t), (RIGHT,)),
        Bar(f"- effect claimed on data with none at {100 * noise:g} % noise", "",
            lambda t: (t.kind == "none") & at(t), (FALSE,)),
    )  # fmt: skip


BARS = (
    Bar("planted effect named exactly, noise <= 1 %, default strengths (upper half decade)", ">= 98 %",
        lambda t: (t.kind == "one") & (t.strength >= DEFAULT) & (t.noise <= QUIET), (RIGHT,), least=0.98),
    Bar("planted effect named exactly, noise <= 1 %, oracle >= 10 nats", ">= 98 %",
        lambda t: _single(t) & (t.noise <= QUIET), (RIGHT,), least=0.98),
    Bar("exact, or a tie that holds the truth, oracle >= 10 nats", ">= 97 %", _planted, (RIGHT, TIE), least=0.97),
    Bar("wrong name, any condition", "<= 1 %", lambda t: t.kind != "none", (WRONG,), most=0.01),
    Bar("effect claimed on data with none", "<= 1 %", lambda t: t.kind == "none", (FALSE,), most=0.01),
    Bar("`none` said on data with none", "", lambda t: t.kind == "none", (RIGHT,)),
    Bar("outside the library: unexplained, or with a remainder, >= 10 nats", ">= 90 %",
        lambda t: (t.kind == "outside") & (t.evidence >= CLEAR), (RIGHT,), least=0.9),
    Bar("two effects, both named, oracle >= 10 nats each", ">= 90 %",
        lambda t: (t.kind == "two") & (t.evidence >= CLEAR), (RIGHT, TIE), least=0.9),
    Bar("similar shape, nearest name or hedged, oracle >= 10 nats", "",
        lambda t: (t.kind == "shape") & (t.evidence >= CLEAR), (RIGHT, TIE, HEDGED, UNEXPLAINED)),
    *(bar for noise in NOISE for bar in _per_noise(noise)),
    Bar("the run failed", "0", lambda t: t.kind != "", (ERROR,), most=0.0),
)  # fmt: skip


def interval(k: int, n: int) -> tuple[float, float]:
    """Return the 95 % interval of a share."""
    low = float(beta.ppf(0.025, k, n - k + 1)) if k else 0.0
    high = float(beta.ppf(0.975, k + 1, n - k)) if k < n else 1.0
    return low, high


def share(k: int, n: int) -> str:
    """Write a share with its interval."""
    if n == 0:
        return "no sets"
    low, high = interval(k, n)
    return f"{k}/{n} = {100 * k / n:.1f} % ({100 * low:.0f}..{100 * high:.0f})"


def report(scores: pd.DataFrame) -> str:
    """Return the whole report in Markdown."""
    t = scores.reset_index(drop=True)
    if "strength" not in t:
        t["strength"] = np.nan
    parts = [f"# Blind exam: {len(t)} sets\n", _markdown(_bars(t)), f"\n{ABOUT}\n\n## Cost\n\n{_markdown(_cost(t))}"]
    parts += [
        f"\n## By {by}\n\n{_markdown(_split(t, by))}"
        for by in ("kind", "condition", "system", "noise", "world", "nuisances")
        if by in t
    ]
    failing = t[t.outcome.isin([WRONG, FALSE, ERROR, PART, HEDGED])]
    if len(failing):
        keys = ["index", "system", "condition", "noise", "planted", "outcome", "names", "evidence", "message"]
        parts.append("\n## What went wrong\n\n" + _markdown(failing.reindex(columns=keys)))
    return "\n".join(parts) + "\n"


def _bars(t: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for bar in BARS:
        of = t[bar.of(t)]
        row = {"figure": bar.figure, "bar": bar.bar} | _shares(of, bar.counts)
        k, n = _count(of, "simpel", bar.counts)
        row["met"] = _met(k / n, bar.least, bar.most) if n and bar.bar else ""
        rows.append(row)
    return pd.DataFrame([*rows, *_against_full(t), *_numbers(t)]).fillna("")


def _shares(of: pd.DataFrame, counts: tuple[str, ...]) -> dict[str, str]:
    """Write the share of everyone's outcomes that count; a rival's among the sets that it was asked."""
    return {name: share(*_count(of, name, counts)) if COLUMN[name] in of else "not installed" for name in TOLD}


def _met(value: float, least: float, most: float) -> str:
    return "yes" if least <= value <= most else "NO"


def _count(of: pd.DataFrame, name: str, counts: tuple[str, ...]) -> tuple[int, int]:
    answers = of[COLUMN[name]].dropna() if COLUMN[name] in of else pd.Series(dtype=object)
    return int(answers.isin(counts).sum()), len(answers)


def _numbers(t: pd.DataFrame) -> list[dict[str, str]]:
    """Rows that are no shares of outcomes: gain on held-out episodes, harm, coverage, time."""
    clear = t[t.kind.isin(["one", "two"]) & (t.evidence >= CLEAR)]
    gain = clear.get("of_oracle", pd.Series(dtype=float)).dropna().astype(float)
    none = t[(t.kind == "none") & t.get("of_before", pd.Series(np.nan, t.index)).notna()]
    safe = int((1 / none.of_before.astype(float) <= HARMLESS).sum()) if len(none) else 0
    inside, counted = (int(t.get(n, pd.Series(0, t.index)).fillna(0).sum()) for n in ("covered", "intervals"))
    spread = f"{gain.median():.3f} (n = {len(gain)}, tenth percentile {gain.quantile(0.1):.2f})"
    return [
        {"figure": "held-out 20-step error: the oracle's over ours, median", "bar": ">= 0.98",
         "simpel": spread if len(gain) else "no sets",
         "met": _met(gain.median(), 0.98, np.inf) if len(gain) else ""},
        {"figure": "no harm where there is nothing to find (error at most 2 % up)", "bar": "100 %",
         "simpel": share(safe, len(none)), "met": _met(safe / len(none), 1, 1) if len(none) else ""},
        {"figure": "intervals of parameters and effects that cover (claimed: 90 %)", "bar": "86-96 %",
         "simpel": share(inside, counted), "met": _met(inside / counted, 0.86, 0.96) if counted else ""},
        *_grown(t), *_told(t), *(_time(t, states) for states in (2, 4)),
    ]  # fmt: skip


def _grown(t: pd.DataFrame) -> list[dict[str, str]]:
    """Row of the sets with an error on test episodes that certainly grows, at any horizon."""
    if "grown" not in t:
        return []
    of = t.grown.dropna()
    row = {"figure": "an error on test episodes grows certainly, any quantity and horizon", "bar": "0"}
    return [row | {"simpel": share(int((of != "").sum()), len(of)), "met": "NO" if (of != "").any() else "yes"}]


def _told(t: pd.DataFrame) -> list[dict[str, str]]:
    """Rows of the nuisances: of how many sets the tool says that they are there; also of those in which one shows."""
    if "named" not in t:
        return []
    asked = t[t.named.notna()]
    said = [json.loads(text) for text in asked.named]
    shows = [json.loads(text) for text in asked["shows"].fillna("{}")] if "shows" in asked else [{}] * len(said)
    rows = []
    for name in sorted({n for each in said for n in each}):
        answers = [each[name] for each in said if name in each]
        rows.append({"figure": f"nuisance named: {name}", "bar": ">= 80 %", "simpel": share(sum(answers), len(answers)),
                     "met": _met(sum(answers) / len(answers), TOLD_LEAST, 1.0)})  # fmt: skip
        clear = [each[name] for each, worth in zip(said, shows, strict=True) if worth.get(name, 0.0) >= CLEAR]
        if clear:
            rows.append({"figure": f"- {name}, where it is worth >= 10 nats", "bar": "",
                         "simpel": share(sum(clear), len(clear)), "met": ""})  # fmt: skip
    return rows


def _searched(t: pd.DataFrame) -> pd.DataFrame:
    """Sets with the seconds of their search, those that failed left out."""
    return t[t.get("seconds", pd.Series(np.nan, t.index)).notna()]


def _time(t: pd.DataFrame, states: int) -> dict[str, str]:
    """Row of the time by number of states; the bar is for two."""
    of = _searched(t)
    of = of[[len(SYSTEMS[name].states) == states for name in of.system]]
    row = {"figure": f"seconds of a search, {states} states, median", "bar": f"<= {SLOWEST:g} s" if states == 2 else ""}
    if of.empty:
        return row | {"simpel": "no sets"}
    seconds, most = of.seconds.astype(float).quantile([0.5, 0.9])
    said = f"{seconds:.1f} s (nine in ten below {most:.1f} s, {of.candidates.median():.0f} candidates)"
    return row | {"simpel": said, "met": _met(seconds, 0, SLOWEST) if states == 2 else ""}


def _cost(t: pd.DataFrame) -> pd.DataFrame:
    """Seconds and memory per system."""
    rows = []
    for system, part in _searched(t).groupby("system"):
        row: dict[str, object] = {"system": system, "states": len(SYSTEMS[str(system)].states), "searches": len(part)}
        for name in ("seconds", "pysindy_seconds", "bic_seconds"):
            seconds = part[name].dropna().astype(float) if name in part else pd.Series(dtype=float)
            row |= {f"{name}, median": seconds.median(), f"{name}, 90 %": seconds.quantile(0.9)}
        rows.append(row | {"memory_mb, most": part["memory_mb"].max() if "memory_mb" in part else np.nan})
    return pd.DataFrame(rows)


def _against_full(t: pd.DataFrame) -> list[dict[str, str]]:
    """Exact or tie among clear sets, per condition; the bar of some is 5 points below full measurement."""
    clear = t[_planted(t)]
    k, n = _count(clear[clear.condition == FULL], "simpel", (RIGHT, TIE))
    least = k / n - WITHIN if n else np.nan
    rows = []
    for condition in (FULL, *EQUAL, *sorted(set(t.condition) - {FULL, *EQUAL})):
        part = clear[clear.condition == condition]
        row = {"figure": f"- exact or tie, oracle >= 10 nats: {condition}", "bar": ""} | _shares(part, (RIGHT, TIE))
        if condition in EQUAL and n:
            k, asked = _count(part, "simpel", (RIGHT, TIE))
            row |= {"bar": f">= {100 * least:.1f} % (full - 5)", "met": _met(k / asked, least, 1.0) if asked else ""}
        rows.append(row)
    return rows


def _split(t: pd.DataFrame, by: str) -> pd.DataFrame:
    rows = []
    for value, part in t.groupby(by):
        clear, none = part[_planted(part)], part[part.kind == "none"]
        row = {by: value, "sets": len(part), "exact, clear": share(*_count(clear, "simpel", (RIGHT,)))}
        row["wrong"] = share(*_count(part[part.kind != "none"], "simpel", (WRONG,)))
        row["false effect"] = share(*_count(none, "simpel", (FALSE,)))
        rows.append(row | {name: int((part.outcome == name).sum()) for name in OUTCOMES})
    return pd.DataFrame(rows)


def _markdown(frame: pd.DataFrame) -> str:
    """Write a table; pandas' own needs another package."""
    if frame.empty:
        return "no sets"
    text = [[_cell(v) for v in row] for row in frame.itertuples(index=False)]
    head = [str(c) for c in frame.columns]
    lines = [head, ["---"] * len(head), *text]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "" if np.isnan(value) else f"{value:.4g}"
    return str(value).replace("|", "/").replace("\n", " ")
