"""Normaliser, gap scale by each rule, and the bank of a world that only answers queries."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from simpel_cli.errors import ConfigError
from simpel_cli.inference.assemble import assemble
from simpel_cli.inference.noise import NoiseModel
from simpel_cli.inference.protocols import Training, padded_length
from simpel_cli.inference.scales import SCALE_DRAWS, SCALE_POINTS, WORLD_SCALE_POINTS
from simpel_cli.inference.system import WORLD_POINTS, normaliser_of, system_of  # fmt: skip
from simpel_cli.priors.function_prior import GapGP, GPPrior, SimulatorPrior
from simpel_cli.priors.gap_scale import marginal_likelihood_scales
from simpel_cli.priors.marginal_likelihood import best_scales, noise_of_smooth, spectrum
from simpel_cli.scores.gaussian import Gaussian
from simulators.model import Declared, Model, ModelError
from simulators.worlds.callable_world import CallableWorld

KEY = jax.random.key(0)
VARIABLES = {
    "states": {"x": {"unit": "m", "range": [-1.0, 1.0]}},
    "inputs": {"u": {"unit": "N", "range": [-2.0, 2.0]}},
    "parameters": {"a": {"unit": "1/s", "range": [0.5, 1.5]}},
}
DT = 0.1


def exact(states, inputs, params):
    """One transition of dx/dt = -a x + u, by its solution."""
    decay = np.exp(-params * DT)
    return states * decay + inputs * (1 - decay) / params


def declared(gap=None):
    return Declared("decay", DT, **VARIABLES, dynamics={"x": "-a*x + u"}, gap=gap or {}).model()


def world(function=exact, batched=True):
    return CallableWorld("decay", DT, function, batched, **VARIABLES).model()


def assembled(system, prior, n=6, seeds=1):
    rng = np.random.default_rng(1)
    states, inputs = rng.uniform(-1, 1, (n, 1)), rng.uniform(-2, 2, (n, 1))
    x = system.encoding.to_x(states, inputs)
    y = exact(states, inputs, np.ones((n, 1))) - states + 0.3 * states**2
    normaliser = normaliser_of(system, KEY)
    return normaliser, assemble(
        system, normaliser, prior, Gaussian(), [Training(x, y)] * seeds, {"x": 0.001}, {},
        noise=NoiseModel(), pool=16, keys=list(jax.random.split(KEY, seeds)), precision="float32",
    )  # fmt: skip


def test_normaliser_is_that_of_the_exact_solution():
    gap = 0.2
    normaliser = normaliser_of(system_of(declared({"x": gap}), (), 0), KEY)
    rng = np.random.default_rng(0)
    x, u, a = rng.uniform(-1, 1, (400_000, 1)), rng.uniform(-2, 2, (400_000, 1)), rng.uniform(0.5, 1.5, (400_000, 1))
    spread = (exact(x, u, a) - x).std()
    np.testing.assert_allclose(normaliser.y_std, np.hypot(spread, gap), rtol=0.03)
    np.testing.assert_allclose(normaliser.x_std, [2 / np.sqrt(12), 4 / np.sqrt(12)])


def test_an_output_that_never_changes_is_refused():
    still = Declared("still", DT, states={"x": {"range": [-1.0, 1.0]}}, dynamics={"x": "0"}).model()
    with pytest.raises(ConfigError, match="`x` in one transition has standard deviation 0"):
        normaliser_of(system_of(still, (), 0), KEY)


def test_gap_scale_by_each_rule():
    system = system_of(declared({"x": 0.2}), (), 0)
    normaliser, stated = assembled(system, SimulatorPrior(GapGP(scale="declared")))
    np.testing.assert_allclose(stated.gap_scale, [0.2])
    np.testing.assert_allclose(stated.problems.gap_scale[0], 0.2 / normaliser.y_std, rtol=1e-6)
    assert assembled(system, SimulatorPrior(GapGP(scale=0.5)))[1].gap_scale == pytest.approx(0.5 * normaliser.y_std)
    assert assembled(system, SimulatorPrior(gap=None))[1].gap_scale is None
    chosen = assembled(system, SimulatorPrior(GapGP(scale="auto")), n=60)[1].gap_scale
    # the data have 0.3 x^2, whose root mean square on the domain is 0.3/sqrt(5) = 0.13, beside the simulator
    assert 0.03 < chosen[0] < 1.0
    bare = assembled(system_of(declared(), (), 0), SimulatorPrior(GapGP(scale="declared")), n=60)[1].gap_scale
    np.testing.assert_allclose(bare, chosen, rtol=0.3)  # what is not declared is chosen


def test_padding_repeats_rows_and_counts_the_real_ones():
    problems = assembled(system_of(declared(), (), 0), SimulatorPrior(), seeds=2)[1].problems
    assert problems.x.shape == (2, padded_length(6), 2)
    assert problems.m.tolist() == [6, 6]
    assert (np.asarray(problems.x[0, 6:]) == np.asarray(problems.x[0, 5])).all()


def test_bank_of_a_world_holds_the_training_inputs_first_and_one_function_per_draw():
    prior = SimulatorPrior(draws=12)
    bank = assembled(system_of(world(), (), 0), prior)[1].problems.bank
    problems = assembled(system_of(world(), (), 0), prior)[1].problems
    np.testing.assert_allclose(bank.x[0, : problems.x.shape[1]], problems.x[0], rtol=1e-6)
    x, u = np.asarray(bank.x[0, :, 0], float), np.asarray(bank.x[0, :, 1], float)
    change = np.asarray(bank.samples[0, :, 0, :], float)  # (points, draws)
    # each draw is one parameter: recover it at one point, predict the others
    at = int(np.argmax(np.abs(x)))
    grid = np.linspace(0.5, 1.5, 20001)
    for draw in range(12):
        guesses = exact(x[at], u[at], grid) - x[at]
        a = grid[np.argmin(np.abs(guesses - change[at, draw]))]
        np.testing.assert_allclose(change[:, draw], exact(x, u, a) - x, atol=2e-4)


def test_a_world_gives_the_normaliser_of_its_equations():
    of_equations = normaliser_of(system_of(declared(), (), 0), KEY)
    of_world = normaliser_of(system_of(world(), (), 0), KEY)
    np.testing.assert_allclose(of_world.y_std, of_equations.y_std, rtol=3 / np.sqrt(WORLD_POINTS))


def test_a_gp_prior_queries_nobody():
    def never(states, inputs, params):
        if len(states) > 16 * WORLD_POINTS:
            raise AssertionError("queried beyond the normaliser")
        return exact(states, inputs, params)

    assert assembled(system_of(world(never), (), 0), GPPrior())[1].problems.bank is None


def test_one_query_at_a_time_gives_the_same():
    single = world(lambda s, u, a: exact(s, u, a), batched=False)
    queries = np.array([[0.3], [-0.2]]), np.array([[1.0], [0.5]]), np.array([[0.7], [1.2]])
    np.testing.assert_allclose(single.step(*queries), world().step(*queries))


def test_wrong_answers_of_a_world_are_named():
    with pytest.raises(ModelError, match="Is `batched` right"):
        world(lambda s, u, a: s[0]).step(np.zeros((3, 1)), np.zeros((3, 1)), np.ones((3, 1)))


def said(error: pytest.ExceptionInfo[ConfigError]) -> dict[str, float]:
    """Numbers that a message names."""
    return {name: float(value) for name, value in re.findall(r"(\w+) = (\S+?)[ ,;]", str(error.value))}


def test_a_world_that_returns_nan_is_named_with_a_query_that_does_it():
    def fails(states, inputs, params):
        return np.where((states > 0.5) & (params < 0.7), np.nan, exact(states, inputs, params))

    with pytest.raises(
        ConfigError, match=r"sim: decay is not finite .*state x = .* m; input u = .* N; parameters a = .* 1/s"
    ) as e:
        normaliser_of(system_of(world(fails), (), 0), KEY)
    point = said(e)
    assert point["x"] > 0.5
    assert point["a"] < 0.7
    assert "make it return finite states" in str(e.value)


def test_a_declared_simulator_that_blows_up_is_named_with_a_point_that_does_it():
    source = Declared("root", DT, **VARIABLES, dynamics={"x": "u + sqrt(a - x)"}).model()
    system = system_of(source, (), 0)
    with pytest.raises(
        ConfigError, match=r"sim: root is not finite .*state x = .* m; input u = .* N; parameters a = .* 1/s"
    ) as e:
        normaliser_of(system, KEY)
    point = said(e)
    assert set(point) == {"x", "u", "a"}
    one = system.transition.step(jnp.array([point["x"], point["u"]]), jnp.array([point["a"]]))
    assert not np.isfinite(one).all()
    assert "sqrt(max(h, 0)), raise sim.substeps" in str(e.value)


def relaxing(high: float) -> Model:
    """A simulator whose integration is stable for k < 27.8 1/s; 2.5 % of its draws lie above `high`."""
    k = {"k": {"unit": "1/s", "range": [0.1, high], "prior": "lognormal"}}
    return Declared("relaxing", DT, **VARIABLES | {"parameters": k}, dynamics={"x": "u - k*x"}).model()


@pytest.mark.parametrize("k", ["model", "world"])
def test_draws_in_the_tail_of_a_law_that_run_away_are_drawn_again(k: str):
    model = relaxing(600.0)
    source = model if k == "model" else world(lambda s, u, a: np.where(a > 1.495, np.nan, exact(s, u, a)))
    system = system_of(source, (), 0)
    x = np.array([[0.3, 0.5], [-0.7, 0.0]])
    values, lost = system.simulate_and_count(KEY, x, 2000)
    assert 0 < lost < 100
    assert np.isfinite(values).all()
    assert np.abs(values).max() < 300
    assert len(np.unique(values[:, 0, 0])) == 2000 - lost


def test_a_few_draws_of_a_tail_are_no_reason_to_refuse_a_simulator():
    system = system_of(relaxing(300.0), (), 0)
    for seed in range(12):  # one in fifty is lost, of 64
        assert np.isfinite(normaliser_of(system, jax.random.key(seed)).y_std).all()


def test_a_law_of_which_too_many_draws_run_away_is_refused():
    with pytest.raises(ConfigError, match="relaxing is not finite"):
        system_of(relaxing(1e300), (), 0).simulate(KEY, np.array([[0.3, 0.5]]), 2000)


def test_training_inputs_at_which_the_simulator_blows_up_are_named_too():
    source = Declared("root", DT, **VARIABLES, dynamics={"x": "u + sqrt(5 + a - x)"}).model()
    system = system_of(source, (), 0)
    normaliser = normaliser_of(system, KEY)
    x = np.array([[0.0, 0.0], [9.0, 1.0], [0.5, -1.0]])
    with pytest.raises(ConfigError, match=r"from state x = 9 m; input u = 1 N; parameters a = .*\(512 of 1536 runs\)"):
        assemble(
            system, normaliser, SimulatorPrior(GapGP(scale="auto")), Gaussian(), [Training(x, x[:, :1])], {}, {},
            noise=NoiseModel(), pool=16, keys=[KEY], precision="float32",
        )  # fmt: skip


@pytest.mark.slow  # thousands of rows
def test_the_gap_scale_of_many_rows_looks_at_all_of_them():
    """Rows in the order of the file: the first half agrees with the simulator, the second is off by a smooth gap."""
    system = system_of(declared(), (), 0)
    normaliser = normaliser_of(system, KEY)
    rng = np.random.default_rng(0)
    rows = 3 * SCALE_POINTS
    states, inputs = rng.uniform(-1, 1, (rows, 1)), rng.uniform(-2, 2, (rows, 1))
    gap = np.where(np.arange(rows)[:, None] < rows // 2, 0.0, 0.3 * states**2 + 0.3 * inputs)
    x = system.encoding.to_x(states, inputs)
    y = exact(states, inputs, np.ones((rows, 1))) - states + gap

    def chosen(rows, key):
        return assemble(
            system, normaliser, SimulatorPrior(GapGP(scale="auto")), Gaussian(), [Training(x[rows], y[rows])], {}, {},
            noise=NoiseModel(), pool=16, keys=[key], precision="float32",
        ).gap_scale[0]  # fmt: skip

    quiet = chosen(slice(0, SCALE_POINTS), KEY)
    assert chosen(slice(None), KEY) > 3 * quiet
    assert chosen(slice(None), KEY) == chosen(slice(None), KEY)
    assert chosen(slice(None), KEY) != chosen(slice(None), jax.random.key(1))


NOISY = 0.05  # normalised


@pytest.mark.parametrize(
    ("prior", "gap"),
    [
        (SimulatorPrior(GapGP(scale=0.5, lengthscale=1.0)), 0.5),
        (SimulatorPrior(GapGP(scale=0.0, lengthscale=1.0)), 0.08),  # a gap that the prior excludes is noise to it
        (SimulatorPrior(gap=None), 0.0),
        (GPPrior(lengthscale=2.0), 0.0),
    ],
    ids=["gap", "excluded", "no gap", "gp"],
)
def test_no_network_learns_less_noise_than_the_prior_leaves(prior, gap):
    system = system_of(declared(), (), 0)
    normaliser = normaliser_of(system, KEY)
    rng = np.random.default_rng(0)
    states, inputs = rng.uniform(-1, 1, (SCALE_POINTS + 1, 1)), rng.uniform(-2, 2, (SCALE_POINTS + 1, 1))
    x = system.encoding.to_x(states, inputs)
    wave = gap * np.cos(4 * states) + NOISY * rng.normal(size=states.shape)
    y = exact(states, inputs, np.ones(states.shape)) - states + wave * normaliser.y_std

    def floor(rows=120, **fields):
        done = assemble(
            system, normaliser, prior, Gaussian(), [Training(x[:rows], y[:rows])], {}, {},
            noise=NoiseModel(**fields), pool=16, keys=[KEY], precision="float32",
        )  # fmt: skip
        return float(done.problems.noise_floor[0, 0])

    unexplained = gap * np.std(np.cos(4 * states)) if prior.gap and prior.gap.scale == 0 else 0.0
    left = (NOISY**2 + unexplained**2 - prior.white_variance) ** 0.5
    assert floor() == pytest.approx(left, rel=0.25)  # 120 values: 6 % standard error
    assert floor(marginal_share=0.5) == pytest.approx(floor() / 2, rel=1e-5)
    assert floor(marginal_share=0.0) == floor(learn=False) == pytest.approx(1e-3)
    assert floor(least_init=0.01) < 0.01  # never above the initial value
    assert floor(400) == pytest.approx(left, rel=0.15)
    assert floor(SCALE_POINTS + 1) == pytest.approx(1e-3)  # so many rows teach the noise themselves


@pytest.mark.parametrize("heavy", [False, True], ids=["Gaussian", "Student's t"])
def test_lengthscales_are_short_along_what_the_simulator_misses_and_long_along_what_it_has(heavy):
    system = system_of(declared(), (), 0)
    normaliser = normaliser_of(system, KEY)
    rng = np.random.default_rng(0)
    states, inputs = rng.uniform(-1, 1, (100, 1)), rng.uniform(-2, 2, (100, 1))
    noise = NOISY * (rng.standard_t(3, states.shape) if heavy else rng.normal(size=states.shape))
    y = exact(states, inputs, np.ones(states.shape)) - states + (0.5 * np.cos(4 * states) + noise) * normaliser.y_std

    def relevance(lengthscale):
        done = assemble(
            system, normaliser, SimulatorPrior(GapGP(lengthscale=lengthscale)), Gaussian(),
            [Training(system.encoding.to_x(states, inputs), y)], {}, {}, noise=NoiseModel(), pool=16, keys=[KEY],
            precision="float32", law="student_t" if heavy else "gaussian",
        ).problems  # fmt: skip
        assert (done.tail is None) != heavy
        return done.gap_relevance

    along_state, along_input = 1 / relevance("auto")[0, 0]
    assert 0.2 < along_state < 1.0
    assert along_input > 4 * along_state
    assert relevance(None) is relevance(2.0) is None


@pytest.mark.parametrize(("law", "times"), [("gaussian", 2.0), ("student_t", 3.0)])
def test_under_students_t_they_are_chosen_once_more_with_rows_that_count_by_their_weights(law, times, monkeypatch):
    def by_weights(kernel, x, samples, targets, white, declared, noise_init, gap=None, weights=None):
        assert (weights is None) == np.all(white > 0)  # Student's t holds the white model error
        return declared * (2.0 if weights is None else 3.0)

    monkeypatch.setattr("simpel_cli.inference.scales.most_likely", by_weights)
    system = system_of(declared(), (), 0)
    rng = np.random.default_rng(1)
    states, inputs = rng.uniform(-1, 1, (30, 1)), rng.uniform(-2, 2, (30, 1))
    y = exact(states, inputs, np.ones(states.shape)) - states + 0.1 * rng.normal(size=states.shape)
    problems = assemble(
        system, normaliser_of(system, KEY), SimulatorPrior(GapGP(lengthscale="auto")), Gaussian(),
        [Training(system.encoding.to_x(states, inputs), y)], {}, {}, noise=NoiseModel(), pool=16, keys=[KEY],
        precision="float32", law=law,
    ).problems  # fmt: skip
    np.testing.assert_allclose(problems.gap_relevance, times * 0.5 / problems.x.shape[-1] ** 0.5, rtol=1e-6)


def test_an_output_without_a_gap_keeps_the_declared_lengthscales():
    prior = SimulatorPrior(GapGP(lengthscale="auto", scale=0.0))
    problems = assembled(system_of(declared(), (), 0), prior, n=30)[1].problems
    np.testing.assert_allclose(problems.gap_relevance, 0.5 / problems.x.shape[-1] ** 0.5)
    assert np.all(np.asarray(problems.gap_scale) == 0)


def test_of_no_data_the_lengthscales_are_those_that_are_declared():
    problems = assembled(system_of(declared(), (), 0), SimulatorPrior(GapGP(lengthscale="auto")), n=0)[1].problems
    np.testing.assert_allclose(problems.gap_relevance, 0.5 / problems.x.shape[-1] ** 0.5)


@pytest.mark.parametrize(("prior", "asked"), [(SimulatorPrior(), True), (GPPrior(scale="auto"), False)])
def test_a_world_is_asked_for_the_scales_at_few_points_and_for_a_gp_not_at_all(prior, asked):
    sizes = []

    def counted(states, inputs, params):
        sizes.append(len(states))
        return exact(states, inputs, params)

    problems = assembled(system_of(world(counted), (), 0), prior, n=300)[1].problems
    assert (WORLD_SCALE_POINTS * SCALE_DRAWS in sizes) == asked
    assert (float(problems.noise_floor[0, 0]) > 1.1e-3) == (not asked)  # 300 rows: more than a world is asked at
    assert 0.01 < float(problems.gap_scale[0, 0]) < 10


def test_a_short_lengthscale_in_many_dimensions_does_not_hide_the_noise():
    """Every row is far from every other by it, so that its marginal likelihood says nothing: longer ones do."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1.7, 1.7, (200, 4))
    y = np.stack([np.sin(x.sum(axis=1)), 0.3 * x[:, 0]], axis=1) + [0.2, 0.02] * rng.normal(size=(200, 2))
    asked = []

    def correlation(longer):
        asked.append(longer)
        squared = ((x[:, None] - x[None]) ** 2).sum(axis=-1)
        return jnp.asarray(np.exp(-squared / (2 * (0.2 * longer) ** 2)))

    given = np.array(200, np.int32), 1e-6, 1.0, np.full(2, 1e-3), np.full(2, 0.1)
    found = noise_of_smooth(correlation, y, *given)
    np.testing.assert_allclose(found, [0.2, 0.02], rtol=0.25)
    assert asked[0] == 1.0
    assert len(set(asked)) == len(asked)
    own = best_scales(spectrum(correlation(1.0), jnp.asarray(y), given[0]), None, *given[1:]).noise
    assert (np.abs(np.log(np.asarray(own) / [0.2, 0.02])) > np.log(1.4)).any()


@pytest.mark.parametrize("gap", [None, 0.2])
def test_the_scales_of_largest_marginal_likelihood_have_no_likelier_neighbour(gap):
    """Against the density of a normal law, by scipy."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=60)
    correlation = np.exp(-((x[:, None] - x[None]) ** 2) / 2)
    samples = rng.normal(size=(100, 2)) @ np.stack([x, np.ones(60)])
    y = 0.3 * x + rng.multivariate_normal(np.zeros(60), 0.2**2 * correlation) + 0.05 * rng.normal(size=60)

    def likely(kappa, sigma):
        law = np.cov(samples, rowvar=False) + kappa**2 * correlation + (1e-4 + sigma**2) * np.eye(60)
        data = stats.multivariate_normal(samples.mean(axis=0), law).logpdf(y)
        return data - np.log(kappa / 0.1) ** 2 / 8 * (gap is None) - np.log(sigma / 0.1) ** 2 / 2

    best = marginal_likelihood_scales(samples, correlation, y, 0.1, 1e-4, gap)
    kappas = [1.0] if gap else [0.97, 1.0, 1.03]
    around = [likely(a * best.gap, b * best.noise) for a in kappas for b in (0.97, 1.0, 1.03)]
    assert np.argmax(around) == len(around) // 2
    assert best.noise == pytest.approx(0.05, rel=0.3)


def test_learned_noise_starts_at_and_stays_above_what_was_measured():
    noise = NoiseModel(floor=1e-3, measured_share=0.7, least_init=0.1)
    init, floor = noise.start(np.array([0.0, 0.02, 0.5]), np.array([0.0, 0.02, 0.5]))
    np.testing.assert_allclose(init, [0.1, 0.1, 0.5])
    np.testing.assert_allclose(floor, [1e-3, 0.014, 0.35])
    rho = noise.init(jnp.asarray(init), jnp.asarray(floor))
    np.testing.assert_allclose(noise.std(rho, jnp.asarray(floor)), init, rtol=1e-9)
    np.testing.assert_allclose(noise.std(jnp.full(3, -50.0), jnp.asarray(floor)), floor)
    assert NoiseModel(measured_share=1.0).start(np.array([0.3]), np.array([0.3]))[1][0] < 0.3
