"""The filter against the exact Gaussian law of a linear system, and its derivatives against differences."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from filter_derivatives import check_derivatives
from linear_plant import DT, LOAD, ROWS, A, B, model, recording
from scipy.stats import multivariate_normal

from simpel_cli.discovery.search.sets.forward import select
from simpel_cli.discovery.search.trials import Search
from simpel_cli.filtering.errors_ahead import _free
from simpel_cli.filtering.likelihood.fit import POINTS, Fitter, Hypothesis
from simpel_cli.filtering.likelihood.sensor_delay import JUMPS
from simpel_cli.filtering.likelihood.track import Noise
from simpel_cli.filtering.setup import Setup, questions, setup
from simulators.effects import Expression
from simulators.model import Declared
from simulators.quantity import Quantity


@pytest.fixture(scope="module")
def plan() -> Setup:
    return setup(model(), recording(), (), [LOAD], 2)


def p_of_plan(plan: Setup, *own: float) -> np.ndarray:
    p = plan.augmented.neutral.copy()
    p[: len(own)] = own
    return p


def p_of(plan: Setup, load: float = 0.0) -> np.ndarray:
    p = p_of_plan(plan, A, B)
    p[[q.name for q in plan.augmented.params].index("load_v_c")] = load
    return p


def exact_log_likelihood(plan: Setup, w: int, r: np.ndarray, q: float, load: float, ok: np.ndarray) -> float:
    """Log density of a window's measurements: a Gaussian vector, written down densely."""
    windows = plan.windows
    decay = np.exp(-A * DT)
    f = np.array([[1.0, (1 - decay) / A], [0.0, decay]])
    half = np.diag([0.0, q**2 * DT / 2])
    mean, cov = windows.start[w].copy(), np.diag(windows.spread[w] ** 2)
    means, joint = [mean], np.zeros((2 * ROWS, 2 * ROWS))
    joint[:2, :2] = cov
    for k in range(1, ROWS):
        u = windows.u[w, plan.lead + k - 1, 0]
        end = (B * u + load) / A
        push = np.array([end * DT - end * (1 - decay) / A, end * (1 - decay)])
        mean = f @ mean + push
        means.append(mean)
        rows = slice(2 * k, 2 * k + 2)
        joint[rows, : 2 * k] = f @ joint[2 * k - 2 : 2 * k, : 2 * k]
        joint[: 2 * k, rows] = joint[rows, : 2 * k].T
        joint[rows, rows] = f @ (joint[2 * k - 2 : 2 * k, 2 * k - 2 : 2 * k] + half) @ f.T + half
    kept = ok.ravel() > 0
    total = joint + np.diag(np.tile(r**2, ROWS))
    return multivariate_normal(np.concatenate(means)[kept], total[np.ix_(kept, kept)]).logpdf(
        windows.y[w].ravel()[kept]
    )


@pytest.mark.parametrize("missing", [(), ((0, 1), (3, 0), (3, 1), (7, 1))])
@pytest.mark.parametrize("load", [0.0, 0.4])
def test_the_likelihood_is_that_of_the_exact_gaussian(plan: Setup, missing: tuple, load: float) -> None:
    r, q = np.array([0.05, 0.07]), 0.3
    ok = plan.windows.ok[1].copy()
    for row, channel in missing:
        ok[row, channel] = 0.0
    data = [jnp.asarray(a[1]) for a in (plan.windows.y, plan.windows.u, plan.windows.start, plan.windows.spread)]
    noise = Noise(jnp.asarray(r), jnp.array([0.0, q]))
    track, _ = plan.rule.track(jnp.asarray(p_of(plan, load)), noise, data[0], jnp.asarray(ok), *data[1:])
    e, s = np.asarray(track.innovation), np.asarray(track.variance)
    ours = -0.5 * np.sum(ok * (np.log(2 * np.pi * s) + e**2 / s))
    np.testing.assert_allclose(ours, exact_log_likelihood(plan, 1, r, q, load, ok), rtol=2e-6)


@pytest.mark.parametrize(("late", "lag"), [(0.0, 1.0), (1.0, 0.0), (1.0, 1.0)])
def test_late_and_lagging_sensors_are_right_to_third_order(late: float, lag: float) -> None:
    """Against exp(-d s)/(1 + tau s) on the exponential with which v settles, which has a closed form."""
    effects = [
        Expression(kind, acts_on="v", operator=kind, parameters={"t": {"range": [0.0, 1.0], "unit": "s"}})
        for kind in ("sensor_delay", "sensor_lag")
    ]
    plan = setup(model(), recording(), (), effects, 4)
    names = [q.name for q in plan.augmented.params]
    u, v_0, end = 0.8, -1.5, 0.8 * B / A
    inputs = jnp.full((plan.lead + ROWS, 1), u)
    deaf, still_there = Noise(jnp.full(2, 1e6), jnp.zeros(2)), (jnp.array([0.0, v_0]), jnp.full(2, 1e-9))
    errors = []
    for t in (0.16, 0.08, 0.02):
        p = p_of_plan(plan, A, B)
        p[names.index("sensor_delay_v_t")], p[names.index("sensor_lag_v_t")] = late * t, lag * t
        rows = jnp.zeros((ROWS, 2))
        track, _ = plan.rule.track(jnp.asarray(p), deaf, rows, rows + 1, inputs, *still_there)
        read = -np.asarray(track.innovation)[2:, 1]
        motion = np.exp(-A * (np.arange(2, ROWS) * DT - late * t)) / (1 - A * lag * t)
        errors.append(np.abs(read - (end + (v_0 - end) * motion)).max())
    assert errors[0] < 2e-3
    assert errors[2] < 1e-6
    assert 9 < errors[0] / errors[1] < 20  # fourth order in the time


def test_a_late_sensor_of_the_simulator_is_read_as_one_that_a_search_finds() -> None:
    late, lag = 0.06, 0.1
    effects = [
        Expression(kind, acts_on="v", operator=kind, parameters={"t": {"range": [0.0, 1.0], "unit": "s"}})
        for kind in ("sensor_delay", "sensor_lag")
    ]
    found = setup(model(), recording(), (), effects, 2)
    names = [q.name for q in found.augmented.params]
    p = p_of_plan(found, A, B)
    p[names.index("sensor_delay_v_t")], p[names.index("sensor_lag_v_t")] = late, lag
    declared = replace(model(), sensor_delay={"v": late}, sensor_lag={"v": "tau"})
    declared = replace(declared, params=(*declared.params, Quantity("tau", "s", 0.0, 1.0)))
    own = setup(declared, recording(), (), effects, 2)
    assert [t.label for t in own.augmented.terms if t.kind in ("sensor_delay", "sensor_lag")] == []
    noise = Noise(jnp.full(2, 0.05), jnp.array([0.0, 0.3]))
    tracks = []
    for plan, at in ((found, p), (own, p_of_plan(own, A, B, lag))):
        data = [jnp.asarray(getattr(plan.windows, name)[1]) for name in ("y", "ok", "u", "start", "spread")]
        tracks.append(np.asarray(plan.rule.track(jnp.asarray(at), noise, *data)[0].innovation))
    np.testing.assert_allclose(tracks[0], tracks[1], rtol=1e-9, atol=1e-12)


def test_a_row_of_one_step_is_fitted_with_a_late_sensor_too() -> None:
    """Nothing jumps within such a row; the slope in the delay is that of differences."""
    late = [
        Expression(
            "sensor_delay", acts_on="v", operator="sensor_delay", parameters={"t": {"range": [0.0, 1.0], "unit": "s"}}
        )
    ]
    plan = setup(model(), recording(), (), late, 1)
    row = [q.name for q in plan.augmented.params].index("sensor_delay_v_t")
    fitter, weight = Fitter(plan.rule, plan.coordinates, plan.windows, width=8), np.ones(len(plan.windows.episode))

    def at(moved: float) -> Hypothesis:
        z = plan.start.copy()
        z[row] = 0.06 + moved
        return Hypothesis(z, (row,), weight)

    here, less, more = fitter([at(0.0), at(-1e-4), at(1e-4)], 1)
    np.testing.assert_allclose(here.gradient, [(more.loss - less.loss) / 2e-4], rtol=0.05)


@pytest.mark.parametrize(
    ("between", "arrives"),
    [("held", 0.0), ("linear", 0.0), ("held", 0.5), ("held", 0.375), ("held", 1.25), ("asked", 0.5)],
)
@pytest.mark.parametrize(("late", "lag"), [(0.0, 0.06), (0.06, 0.0), (0.1, 0.1), (0.3, 0.0), (0.25, 0.1)])
def test_late_sensors_remember_that_the_input_jumped(late: float, lag: float, between: str, arrives: float) -> None:
    """With a slow model, whose rates are those of the input: the reading is the input's integral, delayed and lagged.

    Where inputs go straight from a row to the next, their slopes jump; one that is late itself, by so many rows, jumps within
    a row, also where it is asked whether it is held. A simulation shows the same.
    """
    asked, between = between == "asked", "held" if between == "asked" else between
    effects = [
        Expression(kind, acts_on=on, operator=kind, parameters={"t": {"range": [0.0, 1.0], "unit": "s"}})
        for kind, on in (("sensor_delay", "v"), ("sensor_lag", "v"), ("delay", "u"))
    ]
    effects = effects[: 3 if arrives else 2]
    held_or_not = replace(model(), between_rows={} if asked else {"u": between})
    extra = questions(held_or_not) if asked else ()
    plan = setup(held_or_not, recording(), (), effects, 8 if arrives else 2, extra=extra)
    names = [q.name for q in plan.augmented.params]
    p = p_of_plan(plan, 1e-9, 1.0)
    p[names.index("sensor_delay_v_t")], p[names.index("sensor_lag_v_t")] = late, lag
    if arrives:
        p[names.index("delay_u_t")] = arrives * DT
    u = np.random.default_rng(5).normal(size=ROWS)
    held = np.concatenate([np.full(plan.lead, u[0]), u])
    rows = jnp.zeros((ROWS, 2))
    deaf, known = Noise(jnp.full(2, 1e6), jnp.zeros(2)), (jnp.zeros(2), jnp.full(2, 1e-9))
    track, _ = plan.rule.track(jnp.asarray(p), deaf, rows, rows + 1, jnp.asarray(held)[:, None], *known)
    fine = 400  # steps of a row, of the reference
    times = (np.arange(-20 * fine, ROWS * fine) + 0.5) * DT / fine
    rows_of = np.clip((times // DT).astype(int), 0, ROWS - 1)
    if arrives:
        rows_of = np.clip(np.floor(times / DT - arrives).astype(int), 0, ROWS - 1)
    slope = u[rows_of] if between == "held" else np.interp(times, np.arange(ROWS) * DT, u)
    value = np.cumsum(slope) * DT / fine
    value -= np.interp(0.0, times, value)
    read = value.copy()
    for k in range(1, len(read)):
        read[k] = value[k] if lag == 0 else read[k - 1] + (value[k] - read[k - 1]) * (1 - np.exp(-DT / fine / lag))
    expected = np.interp(np.arange(ROWS) * DT - late, times, read)
    found = -np.asarray(track.innovation)[:, 1]
    begin = 1 if between == "held" else JUMPS + 1  # before the first row inputs go on as they begin
    within = 0.02 * np.abs(expected).max() * (lag > 0) + 2e-3
    np.testing.assert_allclose(found[begin:], expected[begin:], atol=within)
    u_sub = plan.rule.delayed_inputs(jnp.asarray(p), jnp.asarray(held)[:, None])
    simulated = _free(plan.rule, jnp.asarray(p), u_sub, jnp.zeros((ROWS, 2)), jnp.zeros(2), 1, 2)[:, 1]
    np.testing.assert_allclose(simulated[begin:], expected[begin:], atol=within)


def test_derivatives_in_what_moves_are_those_of_differences(plan: Setup) -> None:
    """Exactly in a noise, and in a parameter up to what a row's Jacobian bends within the row."""
    check_derivatives(plan, tuple(jnp.asarray(a[0]) for a in plan.windows[:5]), 1e-6)


def test_a_model_without_unknowns_has_levels_of_noise_to_fit() -> None:
    quantity = {"range": [-3, 3]}
    known = Declared(
        "known", dt=DT, states={"s": {"unit": "m", **quantity}, "v": {"unit": "m/s", **quantity}},
        inputs={"u": {"unit": "V", **quantity}}, parameters={}, dynamics={"s": "v", "v": f"{B}*u - {A}*v"},
    ).model()  # fmt: skip
    plan = setup(known, recording(), (), [], 2, kept=frozenset())
    fitter = Fitter(plan.rule, plan.coordinates, plan.windows, width=4)
    n_p, n_r, n_q = plan.coordinates.sizes
    assert n_p == 0
    (found,) = fitter([Hypothesis(plan.start, tuple(range(n_r + n_q)), np.ones(len(plan.windows.episode)))])
    assert found.converged


@pytest.mark.slow
def test_a_fit_finds_the_optimum_of_the_exact_likelihood(plan: Setup) -> None:
    from scipy.optimize import minimize

    fitter = Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=4, width=len(plan.start))
    n_p, n_r, n_q = plan.coordinates.sizes
    free, weight = tuple(range(n_p + n_r + n_q)), np.ones(len(plan.windows.episode))
    (ours,) = fitter([Hypothesis(plan.start, free, weight)])

    def loss(part: np.ndarray) -> float:
        z = plan.start.copy()
        z[list(free)] = part
        return fitter([Hypothesis(z, (), weight)], 1)[0].loss

    exact = minimize(loss, ours.z[list(free)], bounds=[(0, 1)] * len(free), options={"maxiter": 50})
    assert ours.loss < exact.fun + 0.02


def test_a_batch_has_the_losses_and_slopes_of_its_windows_one_by_one(plan: Setup) -> None:
    fitter = Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=4, width=6)
    free, count = (0, 1, 2, len(plan.start) - 2), len(plan.windows.episode)
    single = fitter([Hypothesis(plan.start, free, np.eye(count)[w]) for w in range(count)], 1)
    (together,) = fitter([Hypothesis(plan.start, free, np.ones(count))], 1)
    prior = fitter([Hypothesis(plan.start, free, np.zeros(count))], 1)[0]
    total = sum(o.loss - prior.loss for o in single) + prior.loss
    np.testing.assert_allclose(together.loss, total, rtol=1e-9)
    np.testing.assert_allclose(
        together.gradient, sum(o.gradient - prior.gradient for o in single) + prior.gradient, rtol=1e-8, atol=1e-9
    )


def test_fits_side_by_side_move_each_its_own_unknowns(plan: Setup) -> None:
    n_p, weight = plan.coordinates.sizes[0], np.ones(len(plan.windows.episode))
    noise = range(n_p, len(plan.start) - 1)
    starts = [Hypothesis(plan.start, (*moves, *noise), weight) for moves in ((), (0, 1), (2,))]
    alone, beside = (
        Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=n, width=len(noise) + 3) for n in (1, 3)
    )
    assert (alone.side_by_side, beside.side_by_side) == (1, 3)
    for one, other in zip(alone(starts, 1), beside(starts, 1), strict=True):
        np.testing.assert_allclose(other.loss, one.loss, rtol=1e-9)
        np.testing.assert_allclose(other.gradient, one.gradient, rtol=1e-8, atol=1e-9)
        np.testing.assert_allclose(other.fisher, one.fisher, rtol=1e-8, atol=1e-9)


def test_fits_of_many_windows_run_one_by_one(plan: Setup) -> None:
    def of(count: int) -> Fitter:
        windows = plan.windows._replace(**{f: np.repeat(a[:1], count, 0) for f, a in plan.windows._asdict().items()})
        return Fitter(plan.rule, plan.coordinates, windows, side_by_side=4)

    assert [of(count).side_by_side for count in (2, POINTS // 4, POINTS // 3, POINTS, 5 * POINTS)] == [4, 4, 3, 1, 1]


def test_noise_alone_is_fitted_the_same_in_a_narrow_program(plan: Setup) -> None:
    fitter = Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=2, width=8)
    n_p, n_r, n_q = plan.coordinates.sizes
    levels, weight = tuple(range(n_p, n_p + n_r + n_q)), np.ones(len(plan.windows.episode))
    starts = [Hypothesis(plan.start, levels, weight), Hypothesis(plan.start, levels[1:], np.eye(len(weight))[0])]
    for wide, narrow in zip(fitter(starts), fitter.of_noise()(starts), strict=True):
        np.testing.assert_allclose(narrow.z, wide.z, atol=1e-9)
        np.testing.assert_allclose(narrow.log_evidence, wide.log_evidence, rtol=1e-9)
        assert narrow.iterations == wide.iterations
    with pytest.raises(ValueError, match="free unknowns"):
        fitter.of_noise()([Hypothesis(plan.start, (0, 1, *levels), weight)])


def test_a_planted_load_is_found_with_its_size_and_none_where_there_is_none() -> None:
    found = {}
    for load in (0.0, 0.5):
        plan = setup(model(), recording(3, load=load), (), [LOAD], 2)
        search = Search(plan, Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=4, width=11))
        found[load] = select(search)
        if load:
            (term,) = found[load].chosen.terms
            assert search.terms[term].effect == "load"
            row = search.rows[term][0]
            i = found[load].chosen.optimum.free.index(row)
            z, span = found[load].chosen.optimum.z[row], plan.coordinates.high[row] - plan.coordinates.low[row]
            sd = span * np.sqrt(found[load].chosen.optimum.covariance[i, i])
            assert abs(plan.coordinates.value(row, z) - load) < 3 * sd < 0.3
    assert found[0.0].chosen.terms == ()
    assert found[0.0].remainder is None


def test_evidence_of_a_nearly_linear_model_is_the_integral(plan: Setup) -> None:
    """Two unknowns on a grid: the Laplace value against the sum."""
    fitter = Fitter(plan.rule, plan.coordinates, plan.windows, side_by_side=4, width=5)
    z = plan.start.copy()
    z[0] = plan.coordinates.unit(0, A)
    free, weight = (1, 2), np.ones(len(plan.windows.episode))
    (best,) = fitter([Hypothesis(z, free, weight)])
    assert best.converged
    sd = np.sqrt(np.diag(best.covariance))
    steps = np.linspace(-5, 5, 21)
    grid = [(best.z[1] + a * sd[0], best.z[2] + b * sd[1]) for a in steps for b in steps]
    hypotheses = []
    for first, second in grid:
        at = best.z.copy()
        at[1], at[2] = first, second
        hypotheses.append(Hypothesis(at, (), weight))
    losses = np.array([o.loss for o in fitter(hypotheses, 1)])
    cell = (steps[1] - steps[0]) ** 2 * sd[0] * sd[1]
    integral = np.log(np.sum(np.exp(-(losses - best.loss))) * cell) - best.loss
    np.testing.assert_allclose(best.log_evidence, integral, atol=0.02)
