"""The greenhouse: numbers of SYSTEMS.md, section 6, through both integrators, and what heat, water and carbon must obey."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import casadi
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from systems import model, whole_node

from simpel_cli.config.build import build
from simpel_cli.dynamics.transition import encoding_of, transition
from simulators import greenhouse as physics
from simulators.model import Model, ModelError
from simulators.parameters import draw
from simulators.worlds.rk4 import RK4

# fmt: off
NOMINAL = {
    "sigma": 7.1708e-5, "chi": 0.0156, "zeta": 2.7060e-5, "xi": 6.3233e-5, "psi": 7.4e-5, "rho_a": 1.29, "c_a": 1010,
    "rho_w": 998, "c_w": 4180, "nu": 0.74783, "tau": 3, "A_p": 314.16, "V_p": 7.85, "phi0": 4e-3, "r_h": 0.3, "beta": 0.01,
    "c_g": 32e3, "c_s": 120e3, "k_r": 7.9, "k_s": 5.75, "k_d": 2.0, "eta": 0.7, "eps": 3, "m1": 1.0183e-3, "m2": 0.33,
    "g1": 20.3e-3, "g2": 0.44, "g3": 2.5e-3, "g4": 3.1e-4, "g_b": 1e-2, "gamma": 0.067, "lam": 0.46153, "l1": 2.501e6,
    "l2": 2.381e3, "omega": 0.622, "p_atm": 101, "d1": 2.1332e-7, "d2": 2.4664e-7, "d3": 20, "d4": 7.4966e-11,
    "f1": 8.1019e-7, "f2": 4.6296e-7, "f": 1.2, "v": 1.23, "v1": 1.3774, "v2": -0.168, "v3": 19, "z": 0.6081, "b1": 2.7,
    "q_g": 2, "q_r": 2, "T_G": 20, "T_R": 25, "M_F": 1.157e-7, "M_L": 2.894e-7, "y_F": 0.5983, "y_L": 0.5983,
    "p_m": 2.2538e-3, "p1": -2.17e-4, "p5": 5e-5, "p3": 577, "p4": 221, "m_p": 4.57, "p_par": 0.475, "w_r": 32.23,
    "l_m": 2.511, "mu": 1.4667, "k_inj": 1e-3, "h_g": 10, "a1": 0.611, "a2": 17.27, "a3": 239, "s1": 1.8407e-4,
    "s2": 9.7838e-4, "s3": 0.051492, "R_g": 8.3144, "T0": 273.15, "M_C": 0.044,
}
ALWAYS_KNOWN = {"rho_a", "rho_w", "gamma", "lam", "p_atm", "m_p", "p_par", "mu", "R_g", "T0", "M_C"}
CONSTANTS_OF_PHYSICS = {"c_a", "c_w", "l1", "l2", "omega", "k_inj", "a1", "a2", "a3", "s1", "s2", "s3"}

DAY = [22, 40, 15, 1.2, 0.012, 3, 80, 10, 0.4, 12, 9, 0.45, 0.007, 3, 350, 4e5]
NIGHT = [16, 45, 12, 0.9, 0.0115, 0.6, 120, 12, 0.7, 2, 8.5, 0.5, 0.004, 4, 0, 6e5]
COLD_PIPE = [16, 14, 12, 0.9, 0.0115, 0.6, 120, 12, 1, 2, 8.5, 0.5, 0.004, 4, 0, 6e5]
POINTS = {"G1": (DAY, [60, 20, 5, 1]), "G2": (NIGHT, [75, 0, 0, 0]), "G3": (COLD_PIPE, [10, 0, 0, 0])}
DAYS_CROP = [-5.160660774e-05, 5.741575314e-05, 5.971481765e-06, 2.364802379e-07]
NIGHTS_CROP = [-6.732837774e-05, 3.398770148e-05, 7.71679155e-06, 1.577632773e-07]
CASES = {
    ("G1", "high"): (
        [-0.002614235024, 0.003282895023, 0.0002354166667, -0.0002180028981, 5.507765292e-06, *DAYS_CROP],
        [21.37587801, 40.95340416, 15.06513101, 1.138728119, 0.01342095373, 2.984864485, 80.01682938, 10.00185246,
         0.4000697988]),
    ("G1", "low"): (
        [0.00368326439, 0, 0.0002354166667, -0.0002180028981, 0, *DAYS_CROP],
        [23.00647842, 40, 15.07735891, 1.138726874, 0.012, 2.98373398, 80.0178608, 10.00170275, 0.4000726635]),
    ("G2", "high"): (
        [-0.002587914809, 0.004792815144, 0.0001333333333, 9.4104e-06, -4.472887838e-07, *NIGHTS_CROP],
        [15.30880761, 46.39216141, 12.03448445, 0.9028154168, 0.01135377196, 0.5801324264, 120.0098652, 12.00238579,
         0.7000456426]),
    ("G2", "low"): (
        [-0.001890708537, 0, 0.0001333333333, 9.4104e-06, 0, *NIGHTS_CROP],
        [15.47226055, 45, 12.03575488, 0.9028154168, 0.0115, 0.5800862346, 120.0099255, 12.00236309, 0.7000460649]),
    ("G3", "high"): (
        [-0.004648600995, -0.0006892242549, 0.0001333333333, 9.4104e-06, -4.472887838e-07, -5.049849711e-05,
         1.252967548e-05, 4.274137142e-06, 0],
        [14.72675308, 13.79611227, 12.03024518, 0.9028154168, 0.01133621454, 0.5852017097, 120.0036224, 12.00141507, 1]),
}
AUXILIARIES: dict[str, tuple[Callable[[physics.Known], float], float, float]] = {
    "phi_v": (physics.ventilation, 0.004383004268, 0.00018224),
    "alpha": (physics.pipe_exchange, 2.012571662, 2.165502477),
    "c_ppm": (physics.carbon_dioxide, 662.6449577, 486.880712),
    "T_c": (physics.cover_temperature, 14.5, 5.5),
    "p_v": (physics.vapour_pressure, 1.634646954, 1.534691094),
    "g_l": (physics.leaf_conductance, 0.01349840362, 0.009775403366),
    "E": (physics.transpiration, 7.699267427e-05, 5.739120873e-06),
    "M_c": (physics.condensation, 0, 8.845208711e-06),
    "P": (physics.photosynthesis, 4.075528741e-05, 0),
    "R": (physics.respiration, 0.000167, 0.000167),
}
# fmt: on
CLOSE = {"rtol": 1.01e-9, "atol": 1e-12}
OWN = (*physics.CLIMATE, *physics.CROP)
SCALE = np.array([30, 50, 20, 8, 0.025, 10, 150, 15, 1])  # of the states OWN
SHUT = dict.fromkeys(("sigma", "zeta", "xi", "psi"), 0.0)
NO_PHASE_CHANGE = {"g_b": 0.0, "m1": 0.0}  # in the dark
FILES = {
    ("low", "inputs"): "greenhouse",
    ("high", "inputs"): "greenhouse_high_fidelity",
    ("low", "states"): "greenhouse_published",
    ("high", "states"): "greenhouse_published_high_fidelity",
}


@cache
def nominal(fidelity: str, weather: str = "inputs", **other: float) -> Model:
    """The greenhouse of nominal constants, all of them known."""
    used = physics.BOTH if fidelity == "low" else (*physics.BOTH, *physics.ONLY_HIGH)
    known = {name: value for name, value in (NOMINAL | other).items() if name in used}
    found = model(FILES[fidelity, weather], **known)
    assert (found.params, found.dt, found.substeps) == ((), 300, 5)
    return found


def split(source: Model, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States and inputs of n greenhouses from the 16 of the table and the controls."""
    n = len(source.states)
    return x[:, :n], np.column_stack([x[:, n:], u])


def rates(source: Model, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Of n greenhouses of known constants, (n, states)."""
    states, inputs = split(source, x, u)
    found = source.function().map(len(x))(states.T, inputs.T, np.zeros((0, len(x))))[0]
    return np.asarray(found).T


def after(source: Model, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """One transition of n greenhouses of known constants, (n, states)."""
    return RK4(source).step(*split(source, x, u), np.zeros((len(x), 0)))


def points(weather: str, n: int = 200) -> tuple[np.ndarray, np.ndarray]:
    """Random ones of the box of a setting: the 16 of the table, the controls."""
    source = nominal("low", weather)
    low, high = np.array([(q.low, q.high) for q in (*source.states, *source.inputs)]).T
    drawn = np.random.default_rng(6).uniform(low, high, (n, len(low)))
    return drawn[:, :16], drawn[:, 16:]


def setting(x: np.ndarray, **values: float | np.ndarray) -> np.ndarray:
    """The points x with other values of some of the 16."""
    x = x.copy()
    for name, value in values.items():
        x[:, (*OWN, *physics.WEATHER).index(name)] = value
    return x


def of(rows: np.ndarray, name: str) -> np.ndarray:
    """The column of one of the 16."""
    column: np.ndarray = rows[:, (*OWN, *physics.WEATHER).index(name)]
    return column


# Numbers of the specification


@pytest.mark.parametrize("case", POINTS)
def test_auxiliaries(case: str) -> None:
    x, u = POINTS[case]
    known = NOMINAL | dict(zip((*OWN, *physics.WEATHER, *physics.CONTROLS), (*x, *u), strict=True))
    for name, (found, day, night) in AUXILIARIES.items():
        expected = day if case == "G1" else 1.571193066 if (case, name) == ("G3", "alpha") else night
        np.testing.assert_allclose(float(found(known)), expected, **CLOSE, err_msg=name)


@pytest.mark.parametrize("weather", ["inputs", "states"])
@pytest.mark.parametrize("fidelity", ["low", "high"])
def test_check_values(fidelity: str, weather: str) -> None:
    cases = [name for name, fid in CASES if fid == fidelity]
    x, u = (np.array([POINTS[case][k] for case in cases], float) for k in range(2))
    slopes, following = (np.array([CASES[case, fidelity][k] for case in cases]) for k in range(2))
    if weather == "states":
        slopes = np.column_stack([slopes, np.tile([0, 0, 0, 0, 0, 0, 1], (len(cases), 1))])
        following = np.column_stack([following, x[:, 9:15], x[:, 15] + 300])
    source = nominal(fidelity, weather)
    np.testing.assert_allclose(rates(source, x, u), slopes, **CLOSE)
    np.testing.assert_allclose(after(source, x, u), following, **CLOSE)


@pytest.mark.parametrize("fidelity", ["low", "high"])
def test_check_values_in_jax(fidelity: str) -> None:
    """And at corners of the formulas, where both integrators give the same."""
    cases = [name for name, fid in CASES if fid == fidelity]
    x, u = points("states")
    x, u = (
        np.vstack([[POINTS[case][0] for case in cases], edges(x)]),
        np.vstack([[POINTS[case][1] for case in cases], u]),
    )
    source = nominal(fidelity)
    encoding = encoding_of(source)
    inputs = jnp.asarray(np.column_stack([x, u]))
    y = jax.jit(jax.vmap(transition(source, encoding).step, in_axes=(0, None)))(inputs, jnp.zeros(0))
    found, expected = np.asarray(inputs[:, :9] + y), after(source, x, u)
    np.testing.assert_allclose(found[: len(cases)], [CASES[case, fidelity][1] for case in cases], **CLOSE)
    np.testing.assert_allclose(found / SCALE, expected / SCALE, rtol=1e-9, atol=1e-12)
    for end in (0, 1):  # of the development stage, put back there
        assert (found[:, 8] == end).sum() > 5


@pytest.mark.parametrize(("fidelity", "weather"), FILES)
def test_files_declare_what_the_table_says(fidelity: str, weather: str) -> None:
    source = model(FILES[fidelity, weather])
    known = ALWAYS_KNOWN | (CONSTANTS_OF_PHYSICS if weather == "inputs" else set())
    used = set(NOMINAL) if fidelity == "high" else set(physics.BOTH)
    assert set(source.fixed) == known & used
    assert {q.name for q in source.params} == used - known
    for name, value in source.fixed.items():
        assert value == pytest.approx(NOMINAL[name], rel=1e-12)
    for q in source.params:
        p = NOMINAL[q.name]
        np.testing.assert_allclose([q.low, q.high], [p - 0.4 * abs(p), p + 0.4 * abs(p)], rtol=1e-12, err_msg=q.name)
    names = (*OWN, *physics.WEATHER, *physics.CONTROLS)
    assert tuple(q.name for q in (*source.states, *source.inputs)) == names  # in this order in every file
    if weather == "states":
        share = dict.fromkeys(physics.CLIMATE, 0.025)
        expected = {q.name: share.get(q.name, 0.005) * (q.high - q.low) for q in source.states}
        assert source.gap == pytest.approx(expected, rel=1e-12)
    else:
        assert tuple(source.gap) == OWN


# What must hold


@pytest.mark.parametrize("fidelity", ["low", "high"])
def test_weather_as_inputs_and_as_states_agree(fidelity: str) -> None:
    x, u = points("states")
    by_inputs, by_states = (after(nominal(fidelity, weather), x, u) for weather in ("inputs", "states"))
    np.testing.assert_allclose(by_inputs / SCALE, by_states[:, :9] / SCALE, rtol=1e-9, atol=4e-11)
    aged = of(by_inputs, "D") - of(by_states, "D")  # by d4 t, whose t stands still among the inputs
    np.testing.assert_allclose(aged[of(by_states, "D") > 0], 7.4966e-11 / 86400 * 300**2 / 2, rtol=1e-4)
    np.testing.assert_array_equal(by_states[:, 9:15], x[:, 9:15])
    np.testing.assert_allclose(by_states[:, 15], x[:, 15] + 300, rtol=1e-12)


def test_both_fidelities_have_the_same_carbon_soil_and_crop() -> None:
    x, u = points("inputs")
    same = [OWN.index(name) for name in ("C", "T_s", *physics.CROP)]
    low, high = (rates(nominal(fidelity), x, u) for fidelity in ("low", "high"))
    np.testing.assert_allclose(low[:, same], high[:, same], rtol=1e-12)
    assert (low[:, [1, 4]] == 0).all()
    assert (high[:, [1, 4]] != 0).all()


@pytest.mark.parametrize("fidelity", ["low", "high"])
def test_at_one_temperature_in_the_dark_nothing_happens(fidelity: str) -> None:
    """Air that is saturated, indoors and outdoors: no heat flows, nothing evaporates or condenses."""
    x, u = points("inputs", 20)
    T = of(x, "T_g")
    V = 0.611 * np.exp(17.27 * T / (239 + T)) / (0.46153 * (T + 273.15))
    x = setting(x, T_p=T, T_s=T, T_o=T, T_d=T, V=V, V_o=V, G=0)
    found = rates(nominal(fidelity), x, np.column_stack([T, u[:, 1:]]))
    np.testing.assert_allclose(found[:, [0, 1, 2, 4]], 0, atol=1e-15)


@pytest.mark.parametrize("fidelity", ["low", "high"])
def test_heat_stays_in_a_closed_greenhouse(fidelity: str) -> None:
    """Of air, soil and pipe (per area of its surface), over a transition; nothing leads out, nothing evaporates."""
    x, u = points("inputs")
    x = setting(x, G=0)
    source = nominal(
        fidelity, **SHUT, **NO_PHASE_CHANGE, k_r=0, k_d=0, phi0=0, **({"nu": 0} if fidelity == "low" else {})
    )
    capacity = np.array([32e3, 998 * 4180 * 7.85 / 314.16, 120e3])
    found = after(source, x, u)
    np.testing.assert_allclose(found[:, :3] @ capacity, x[:, :3] @ capacity, rtol=1e-12)
    assert np.abs(found[:, 0] - x[:, 0]).max() > 0.5


def test_evaporation_takes_its_heat_from_the_air() -> None:
    """A closed greenhouse at one temperature: what the sun gives goes into air and vapour."""
    x, u = points("inputs")
    T = of(x, "T_g")
    x = setting(x, T_p=T, T_s=T, T_o=T)
    found = rates(nominal("high", **SHUT), x, u)
    vapour = 10 * of(found, "V")  # kg/(m^2 s)
    np.testing.assert_allclose(32e3 * of(found, "T_g") + (2.501e6 - 2.381e3 * T) * vapour, 0.7 * of(x, "G"), rtol=1e-9)
    assert vapour.min() > 1e-5


def test_condensation_warms_air_and_cover() -> None:
    x, u = points("inputs")
    T = of(x, "T_g")
    x = setting(x, T_p=T, T_s=T, G=0)
    found = rates(nominal("high", **SHUT, k_r=0, g_b=0), x, u)
    condensed = -10 * of(found, "V")
    np.testing.assert_allclose(
        32e3 * of(found, "T_g"), (2.501e6 - 2.381e3 * T) * condensed / (1 + 3), rtol=1e-9, atol=1e-12
    )
    assert (condensed >= 0).all()
    assert 0.1 < (condensed > 0).mean() < 0.9


@pytest.mark.parametrize(("wind", "leeward", "windward", "exchange"), [(0, 0, 0, 7.4e-5), (3, 20, 5, 0.004383004268)])
def test_ventilation_mixes_in_the_air_outdoors(wind: float, leeward: float, windward: float, exchange: float) -> None:
    """In the dark, without transpiration and condensation, CO2 and vapour relax exponentially."""
    x, u = points("inputs")
    x = setting(x, G=0, w=wind)
    u[:, 1], u[:, 2] = leeward, windward
    found = after(nominal("high", **NO_PHASE_CHANGE), x, u)
    left = np.exp(-exchange * 300 / 10)
    limit = of(x, "C_o") + (1e-3 * u[:, 3] + 0.000167) / exchange
    np.testing.assert_allclose(of(found, "C"), limit + (of(x, "C") - limit) * left, rtol=1e-8)
    np.testing.assert_allclose(of(found, "V"), of(x, "V_o") + (of(x, "V") - of(x, "V_o")) * left, rtol=1e-8)


def test_photosynthesis_takes_the_carbon_that_it_stores() -> None:
    x, u = points("inputs")
    change = rates(nominal("low"), x, u) - rates(nominal("low"), setting(x, G=0), u)
    np.testing.assert_allclose(10 * of(change, "C"), -1.4667 * of(change, "B"), rtol=1e-9)
    assert of(change, "B").min() > 0


@pytest.mark.parametrize("fidelity", ["low", "high"])
def test_a_crop_in_the_dark_without_assimilates_does_not_grow(fidelity: str) -> None:
    x, u = points("inputs")
    found = after(nominal(fidelity), setting(x, B=0, G=0), u)
    np.testing.assert_array_equal(of(found, "B"), 0)
    assert (of(found, "W_F") < of(x, "W_F")).all()
    assert (of(found, "W_L") < of(x, "W_L")).all()
    fed = after(nominal(fidelity), setting(x, B=5, D=0.4), u)
    assert (of(fed, "W_F") > of(x, "W_F")).all()
    assert (of(fed, "W_L") > of(x, "W_L")).all()


@pytest.mark.parametrize("stage", [0.0, 1e-6, 0.5, 1 - 1e-6, 1.0])
@pytest.mark.parametrize("fidelity", ["low", "high"])
def test_the_development_stage_stays_between_0_and_1(fidelity: str, stage: float) -> None:
    """Cold air sets it back, warm air brings it on."""
    x, u = points("states")
    x = setting(x, D=stage)
    following = of(after(nominal(fidelity, "states"), x, u), "D")
    assert following.min() >= 0
    assert following.max() <= 1
    assert (following == 0).any() == (stage < 1e-5)
    assert (following == 1).any() == (stage > 1 - 1e-5)


def test_limits_act_after_a_step_never_inside_one() -> None:
    """Condensation far too fast for the step would leave negative humidity."""
    x, u = points("inputs", 50)
    x = setting(x, V=0.0135, T_o=0)
    source = nominal("high", m1=10, g_b=0, eps=1000)  # eps: its heat goes outdoors
    short = replace(source, dt=60, substeps=1)
    free = replace(short, limits={})
    low, high = np.array([source.limits[name] for name in OWN]).T
    once, unlimited = after(short, x, u), after(free, x, u)
    assert of(unlimited, "V").min() < 0
    assert of(once, "V").min() == 0
    np.testing.assert_array_equal(once, np.clip(unlimited, low, high))
    following = x
    for _ in range(5):
        following = np.column_stack([np.clip(after(free, following, u), low, high), x[:, 9:]])
    np.testing.assert_allclose(after(source, x, u), following[:, :9], rtol=1e-12)


def edges(x: np.ndarray) -> np.ndarray:
    """Points of the box at which a formula has a corner or would have a pole."""
    T = of(x, "T_g")
    cover = (3 * of(x, "T_o") + T) / 4

    def saturated(T: np.ndarray) -> np.ndarray:
        return 0.611 * np.exp(17.27 * T / (239 + T))

    def humidity(p: np.ndarray) -> np.ndarray:
        return p / (0.46153 * (T + 273.15))

    k = np.arange(len(x))
    x = setting(x, T_p=np.where(k % 2 == 0, T, of(x, "T_p")), G=np.where(k % 3 == 0, 0, of(x, "G")))
    x = setting(
        x, V=np.select([k % 5 == 0, k % 5 == 1], [humidity(saturated(T)), humidity(saturated(cover))], of(x, "V"))
    )
    x = setting(x, D=np.select([k % 4 == 0, k % 4 == 1], [0.0, 1.0], of(x, "D")), w=np.where(k % 6 == 1, 0, of(x, "w")))
    x = setting(
        x, **{name: np.where(k % 7 == i, 0, of(x, name)) for i, name in enumerate(("C", "B", "W_F", "W_L", "V"))}
    )
    x = setting(x, T_o=np.where(k % 11 == 0, of(x, "T_g"), of(x, "T_o")))
    x[-1] = 0  # everything, temperatures too
    x[-2] = setting(x[-2:-1], T_g=0.05 * 20)[0]
    return x


@pytest.mark.slow  # gradients of nine states at many points
def test_slopes_are_finite() -> None:
    """Of the one-step map, in states, inputs and parameters: in JAX in single precision, in CasADi in double precision."""
    source = model(FILES["high", "states"])
    x, u = points("states")
    x[100:] = edges(x[100:])
    phi = draw(source.params, np.random.default_rng(2), 200)
    phi[150:] = [NOMINAL[q.name] for q in source.params]
    step = transition(source, encoding_of(source)).step
    weight = np.random.default_rng(3).normal(size=16) / np.array([q.high - q.low for q in source.states])
    single = [jnp.asarray(a, jnp.float32) for a in (np.column_stack([x, u]), phi, weight)]

    def total(x: jax.Array, phi: jax.Array, weight: jax.Array) -> jax.Array:
        return step(x, phi) @ weight

    lowered = jax.jit(jax.vmap(jax.value_and_grad(total, argnums=(0, 1)), in_axes=(0, 0, None))).lower(*single)
    # as it stands XLA takes a minute to compile this
    value, slopes = lowered.compile({"xla_disable_hlo_passes": "fusion", "xla_backend_optimization_level": 0})(*single)
    np.testing.assert_allclose(value, (RK4(source).step(x, u, phi) - x) @ weight, atol=1e-4)
    for found in slopes:
        assert np.isfinite(found).all()
        assert (np.abs(found).max(axis=0) > 0).mean() > 0.9
    symbols = [source.function().sx_in(i) for i in range(3)]
    jacobian = casadi.jacobian(source.function()(*symbols)[0], casadi.vertcat(*symbols))
    values = casadi.Function("J", symbols, [jacobian]).map(len(x))(x.T, u.T, phi.T)
    assert np.isfinite(np.asarray(values)).all()


def test_a_pipe_as_warm_as_the_air_still_answers() -> None:
    """Where sqrt|T_g - T_p| has no slope, the heat that the pipe gives has one: nu sqrt(tau)."""
    source = nominal("high")
    symbols = [source.function().sx_in(i) for i in range(3)]
    slope = casadi.Function("J", symbols, [casadi.jacobian(source.function()(*symbols)[0][1], symbols[0][1])])
    states, inputs = split(source, setting(np.array([DAY]), T_p=22), np.zeros((1, 4)))
    expected = -314.16 / (998 * 4180 * 7.85) * 0.74783 * np.sqrt(3) - 2 * 4e-3 * 0.3 / 1.7 / 7.85
    assert float(slope(states[0], inputs[0], [])) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(("fidelity", "weather"), FILES)
def test_transitions_are_finite_over_the_box(fidelity: str, weather: str) -> None:
    source = model(FILES[fidelity, weather])
    x, u = points(weather, 1000)
    phi = draw(source.params, np.random.default_rng(4), len(x))
    found = RK4(source).step(*split(source, x, u), phi)
    assert np.isfinite(found).all()
    assert -30 < of(found, "T_g").min() < of(found, "T_g").max() < 60


def test_a_ripe_crop_is_not_harvested_while_cold_air_sets_it_back() -> None:
    x, u = points("states")
    for T_g, grows in ((2, False), (25, True)):
        ripe, almost = (rates(nominal("low"), setting(x, T_g=T_g, D=D), u) for D in (1, 1 - 1e-9))
        assert (of(almost, "D") > 0).all() == grows
        if grows:
            assert (of(ripe, "D") == 0).all()
            assert (of(ripe, "W_F") < of(almost, "W_F")).all()
        else:
            np.testing.assert_allclose(ripe, almost, rtol=1e-6, atol=1e-12)


def test_formulas_of_vapour_have_no_poles() -> None:
    known = NOMINAL | {"C": -0.4, "T_g": 20, "W_L": 10, "G": 300}  # at C = -0.4 half saturation would be one
    warmer, denser = np.linspace(-273.15, 200, 1000), np.linspace(0, 1000, 1000)
    pressures = [float(physics.saturation(T, known)) for T in warmer]
    ratios = [float(physics.humidity_ratio(p, known)) for p in denser]
    for found in (pressures, ratios):
        assert (np.diff(found) >= 0).all()
        assert np.isfinite(found).all()
    assert float(physics.photosynthesis(known)) == 0


@pytest.mark.parametrize("T", [-273.15, -239.0, -30.0, 99.5, 101.0, 200.0])
def test_far_away_rates_stay_finite(T: float) -> None:
    """At temperatures where the formulas of vapour have poles, and at negative masses, of noise or of a stage."""
    x, u = points("inputs", 50)
    far = setting(x, T_g=T, T_p=T, T_s=T, T_o=T, C=-0.2, V=-0.001, B=-1e3, W_F=-1, W_L=-1, D=-0.1)
    for place in (far, setting(far, V=0.8)):
        assert np.isfinite(rates(nominal("high"), place, u)).all()
        if -50 < T < 150:
            found = after(nominal("high"), place, u)
            assert np.isfinite(found).all()
            assert (found[:, 3:] >= 0).all()


# What is refused


@pytest.mark.parametrize(
    ("file", "section", "gone", "more", "message"),
    [
        ("greenhouse", "parameters", "psi", {}, r"sim\.parameters: no psi, which the equations of Greenhouse use"),
        (
            "greenhouse",
            "parameters",
            "",
            {"g1": 0.02},
            r"sim\.parameters\.g1: the equations of Greenhouse do not use it",
        ),
        ("greenhouse_high_fidelity", "parameters", "g1", {}, r"sim\.parameters: no g1, which"),
        (
            "greenhouse_high_fidelity",
            "parameters",
            "",
            {"sigmaa": 1},
            r"sim\.parameters\.sigmaa: .* Did you mean sigma\?",
        ),
        ("greenhouse", "inputs", "T_o", {}, r"sim\.inputs: no T_o, which"),
        ("greenhouse_published", "states", "T_o", {}, r"sim\.states: no T_o, which"),
        ("greenhouse_published", "inputs", "", {"rain": {"range": [0, 1]}}, r"sim\.inputs\.rain: the equations of"),
    ],
)
def test_names_that_are_missing_or_unknown(
    file: str, section: str, gone: str, more: dict[str, object], message: str
) -> None:
    content = whole_node(file)
    content[section] = {name: value for name, value in content[section].items() if name != gone} | more
    with pytest.raises(ModelError, match=message):
        build(content, "sim").model()


@pytest.mark.parametrize(("key", "allowed"), [("fidelity", "low or high"), ("weather", "inputs or states")])
def test_wrong_words_are_refused(key: str, allowed: str) -> None:
    with pytest.raises(ModelError, match=rf"sim\.{key}: 'rainy' is not allowed, only {allowed}"):
        physics.Greenhouse("g", 300, **{key: "rainy"})
