"""Single values that the calibrated simulator cannot follow, and that it need not: the rows after them say so.

A value is left out of the filter on trial. It stays out if it is far from what all other rows say of it,

    e_s = e - c (x_s - x_p),    var e_s = c P_s c' + r^2/ok,    |e_s| > FAR standard deviations,

with the smoothed state x_s, and if the next two rows are as expected without it. A jump, an impact or a wrong model
stays wrong in the next row, and is left alone. Standard deviations hold the process noise that a wrong model asks for.

Reference: Rauch, Tung and Striebel (1965) for x_s and P_s.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from simpel_cli.data.recording import Episode
from simpel_cli.filtering.errors_ahead import Assessor
from simpel_cli.filtering.likelihood.latent_force import smooth
from simpel_cli.filtering.measurements.cleaning import MOST_SHARE, Cleaned, Place
from simpel_cli.filtering.measurements.windows import Windows, pieces

FAR = 6.0  # standard deviations
FAR_AT_END = 8.0  # of the last row, which no other one confirms
FINE = 4.0
PASSES = 3  # one outlier can hide another one


def gated(assessor: Assessor, z: np.ndarray, windows: Windows) -> Windows:
    """Return windows in which values that stand alone do not count.

    Args:
        assessor: of the models.
        z: unit coordinates of the calibrated simulator.
        windows: to look at.
    """
    for _ in range(PASSES):
        suspects = _suspects(assessor, z, windows)
        if not suspects.any():
            break
        trial = windows._replace(ok=np.where(suspects, 0.0, windows.ok))
        alone = suspects & _stands_alone(assessor, z, trial, windows.ok)
        if not alone.any():
            break
        windows = windows._replace(ok=np.where(alone, 0.0, windows.ok))
    return windows


def _suspects(assessor: Assessor, z: np.ndarray, windows: Windows) -> np.ndarray:
    """First values of every run of large innovations, (W, T, ny), and first rows that make the second one look wrong."""
    track = assessor(z, windows).track
    counts = windows.ok > 0
    far = np.where(counts, np.abs(track.innovation) / np.sqrt(track.variance), 0.0) > FAR
    first = far.copy()
    first[:, 1:] &= ~far[:, :-1]
    first[:, 2:] &= ~far[:, :-2]
    first[:, 0] |= far[:, 1] & counts[:, 0]
    return first


def _stands_alone(assessor: Assessor, z: np.ndarray, windows: Windows, ok: np.ndarray) -> np.ndarray:
    """Whether each value, were it left out, is far from what the others say, and these agree, (W, T, ny).

    Args:
        assessor: of the models.
        z: unit coordinates of the calibrated simulator.
        windows: without the suspects.
        ok: how much each value counts that is not left out: its noise has the variance r^2/ok.
    """
    track = assessor(z, windows).track
    try:
        smoothed = smooth(track)
    except np.linalg.LinAlgError:  # a filter that is sure of everything, as of a stuck sensor: nothing to go by
        return np.zeros(windows.ok.shape, bool)
    r = np.asarray(assessor.plan.coordinates.physical(jnp.asarray(z))[1].r)
    moved = np.einsum("wtji,wti->wtj", track.slope, smoothed.mean - track.predicted)
    spread = np.einsum("wtji,wtik,wtjk->wtj", track.slope, smoothed.cov, track.slope)
    distance = np.abs(track.innovation - moved) / np.sqrt(np.maximum(spread, 0.0) + r**2 / np.where(ok > 0, ok, 1.0))
    counts = windows.ok > 0
    fine = ~counts | (np.abs(track.innovation) / np.sqrt(track.variance) < FINE)
    settled = np.ones_like(fine)
    settled[:, :-1] &= fine[:, 1:]
    settled[:, :-2] &= fine[:, 2:]
    confirmed = np.zeros_like(fine)
    confirmed[:, :-1] = np.logical_or.accumulate(counts[:, ::-1], axis=1)[:, ::-1][:, 1:]
    return np.asarray(settled & (distance > np.where(confirmed, FAR, FAR_AT_END)))


def without_new(
    found: Cleaned, old: dict[str, Windows], new: dict[str, Windows], names: Sequence[str]
) -> tuple[Cleaned, dict[str, Windows]]:
    """Add what gating left out to what was left out before; of a channel with too much, gating leaves out nothing.

    Args:
        found: before gating.
        old: windows of train and test, and those of train that a search leaves out (spare), before it.
        new: after it.
        names: of the channels.
    """
    train, test = found.recording.train, found.recording.test
    rows = sum(len(e.time) for e in (*train, *test))
    whose = {"train": ("train", train), "test": ("test", test), "spare": ("train", train)}
    places = [p for part in old for p in _places(old[part], new[part], *whose[part], names)]
    too_many = dict(found.too_many)
    for j, name in enumerate(names):
        share = sum(p.name == name for p in (*found.left_out, *places)) / rows
        if share > MOST_SHARE or name in too_many:
            too_many[name] = max(share, too_many.get(name, 0.0))
            new = {split: w._replace(ok=_column_of(w.ok, old[split].ok, j)) for split, w in new.items()}
            places = [p for p in places if p.name != name]
    return found._replace(left_out=(*found.left_out, *places), too_many=too_many), new


def _column_of(ok: np.ndarray, other: np.ndarray, j: int) -> np.ndarray:
    changed = ok.copy()
    changed[..., j] = other[..., j]
    return changed


def _places(old: Windows, new: Windows, split: str, episodes: Sequence[Episode], names: Sequence[str]) -> list[Place]:
    found = []
    for w, piece in enumerate(pieces(old, episodes)):
        gone = (old.ok[w] > 0) & (new.ok[w] == 0)
        for k, j in np.argwhere(gone):
            found.append(Place(names[j], split, int(old.episode[w]), int(piece.rows[k])))
    return found
