"""Climate of a heated, ventilated, CO2-dosed greenhouse and the tomato crop in it.

Heat (W/m^2), CO2 (g/(m^2 s)) and water (kg/(m^2 s)) per ground area; of the crop assimilates, fruit and leaves:

    c_g T_g' = (k_v + k_r)(T_o - T_g) + alpha (T_p - T_g) + k_s (T_s - T_g) + eta G - ell E + ell M_c/(1 + eps)
    V_p T_p' = A_p/(rho_w c_w) [beta G - alpha (T_p - T_g)] + phi (T_h - T_p)
    c_s T_s' = k_s (T_g - T_s) + k_d (T_d - T_s)
    h_g C'   = phi_v (C_o - C) + k_inj phi_c + R - mu P
    h_g V'   = E - phi_v (V - V_o) - M_c
    B'   = P - b [(f G_F + r_F) W_F + (v G_L + r_L) W_L/z]
    W_F' = [b G_F - (1 - b) r_F - h y_F] W_F,   W_L' = [b G_L - (1 - b) r_L - h y_L] W_L,   D' = d - h

Low fidelity has no pipe, no humidity balance and no latent heat: T_p' = V' = 0, and the heating water acts on the air,

    c_g T_g' = (k_v + k_r)(T_o - T_g) + nu sqrt(tau) (T_h - T_g) + k_s (T_s - T_g) + eta G

Sources: Tap (2000, thesis, Wageningen); van Straten, van Willigenburg, van Henten and van Ooteghem (2010, book); ventilation
de Jong (1990); leaf conductance Nederhoff and de Graaf (1993); development of the crop de Koning (1994).
"""

from collections.abc import Mapping
from dataclasses import dataclass

import casadi

from simulators.built import FIDELITIES, Built
from simulators.expression import Symbol
from simulators.quantity import check_word

CLIMATE = ("T_g", "T_p", "T_s", "C", "V")
CROP = ("B", "W_F", "W_L", "D")
WEATHER = ("T_o", "T_d", "C_o", "V_o", "w", "G", "age")
CONTROLS = ("T_h", "r_l", "r_w", "phi_c")

VENTILATION = ("sigma", "chi", "zeta", "xi", "psi")
HEAT = ("rho_a", "c_a", "nu", "tau", "c_g", "c_s", "k_r", "k_s", "k_d", "eta")
CARBON = ("h_g", "k_inj", "mu", "R_g", "T0", "M_C", "p_atm", "p1", "p5")
CANOPY = ("p_m", "p3", "p4", "m_p", "p_par", "w_r", "l_m")
GROWTH = ("b1", "f", "v", "z", "f1", "f2", "q_g", "T_G", "v1", "v2", "v3", "q_r", "T_R", "M_F", "M_L", "y_F", "y_L")
DEVELOPMENT = ("d1", "d2", "d3", "d4")
PIPE = ("A_p", "V_p", "rho_w", "c_w", "phi0", "r_h", "beta")
VAPOUR = ("lam", "a1", "a2", "a3", "s1", "s2", "s3", "l1", "l2", "gamma", "omega")
LEAF = ("g1", "g2", "g3", "g4", "g_b")
COVER = ("eps", "m1", "m2")
BOTH = (*VENTILATION, *HEAT, *CARBON, *CANOPY, *GROWTH, *DEVELOPMENT)
ONLY_HIGH = (*PIPE, *VAPOUR, *LEAF, *COVER)

DAY = 86400.0  # s
NARROW = 1e-6  # K; below, powers of a temperature difference are straight lines
Known = Mapping[str, Symbol]


@dataclass(frozen=True)
class Greenhouse(Built):
    """A greenhouse.

    Args:
        fidelity: `low` or `high`, see above.
        weather: `inputs`: T_o to age are inputs, held over a transition; `states`: they are states, constant but for age' = 1.
        states: T_g, T_p, T_s of air, pipe and soil (degC), C (CO2, g/m^3), V (humidity, kg/m^3), B (assimilate buffer,
            g/m^2), W_F, W_L (dry mass of fruit and leaves, g/m^2), D (development stage, 0..1).
        inputs: T_h (heating water, degC), r_l, r_w (leeward and windward window opening, %), phi_c (CO2 dosing, mg/(m^2 s)).
            Weather: T_o, T_d outdoors and deep in the soil (degC), C_o (g/m^3), V_o (kg/m^3), w (wind, m/s), G (radiation,
            W/m^2), age (time since planting, s).
        parameters: of both fidelities (no unit: a number)
            ventilation: sigma, chi, xi (1/%), zeta, psi (m/s).
            heat: rho_a (kg/m^3), c_a (J/(kg K)), nu (W/(m^2 K^1.25)), tau (K^0.5), c_g, c_s (J/(m^2 K)), k_r, k_s, k_d
            (W/(m^2 K)), eta.
            carbon: h_g (m), k_inj (g/mg), mu, R_g (J/(mol K)), T0 (K), M_C (kg/mol), p_atm (kPa), p1, p5 (g/(m^2 s)).
            canopy: p_m (g/(m^2 s)), p3 (umol/(m^2 s)), p4 (ppm), m_p (umol/J), p_par, w_r (g/m^2), l_m.
            growth: b1 (m^2/g), f, v, z, v1, q_g, q_r, y_F, y_L, f1, f2, M_F, M_L (1/s), v2 (1/K), v3, T_G, T_R (degC).
            development: d1, d2 (1/s), d3 (degC), d4 (1/(s d)).
            Of high fidelity also
            pipe: A_p (m^2), V_p (m^3), rho_w (kg/m^3), c_w (J/(kg K)), phi0 (m^3/s), r_h, beta.
            vapour: lam (kPa m^3/(kg K)), a1 (kPa), a2, a3 (degC), s1 (kPa/K^3), s2 (kPa/K^2), s3 (kPa/K), l1 (J/kg), l2
            (J/(kg K)), gamma (kPa/K), omega.
            leaf: g1, g_b (m/s), g2, g3 (m^2/W), g4 (1/ppm).
            cover: eps, m1 (kg/(m^2 s K^m2)), m2.

    """

    fidelity: str = "high"
    weather: str = "inputs"

    def __post_init__(self) -> None:
        """Refuse words that are not allowed."""
        check_word("sim.fidelity", self.fidelity, FIDELITIES)
        check_word("sim.weather", self.weather, ("inputs", "states"))

    def needed(self) -> dict[str, tuple[str, ...]]:
        """Return the names that the equations use; both fidelities have the same states and inputs."""
        own = (*CLIMATE, *CROP)
        return {
            "states": (*own, *WEATHER) if self.weather == "states" else own,
            "inputs": CONTROLS if self.weather == "states" else (*WEATHER, *CONTROLS),
            "parameters": (*BOTH, *ONLY_HIGH) if self.fidelity == "high" else BOTH,
        }

    def rates(self, known: Known) -> list[Symbol]:
        """Return d(state)/dt."""
        climate = wet_climate(known) if self.fidelity == "high" else dry_climate(known)
        constant = dict.fromkeys(WEATHER, casadi.SX(0)) | {"age": casadi.SX(1)}
        rate = climate | crop(known) | constant
        return [rate[name] for name in self.states]


# Climate: each from what the names stand for, k


def dry_climate(k: Known) -> dict[str, Symbol]:
    """Return the rates of the climate, low fidelity."""
    heating = k["nu"] * casadi.sqrt(k["tau"]) * (k["T_h"] - k["T_g"])
    return {
        "T_g": (_sensible_heat(k) + heating) / k["c_g"],
        "T_p": casadi.SX(0),
        "T_s": _soil(k),
        "C": _carbon(k),
        "V": casadi.SX(0),
    }


def wet_climate(k: Known) -> dict[str, Symbol]:
    """Return the rates of the climate, high fidelity."""
    heating = pipe_exchange(k) * (k["T_p"] - k["T_g"])
    E, M_c = transpiration(k), condensation(k)
    latent = latent_heat(k) * (M_c / (1 + k["eps"]) - E)
    flow = 2 * k["phi0"] * k["r_h"] / (2 - k["r_h"])  # m^3/s, through the mixing valve
    absorbed = k["A_p"] / (k["rho_w"] * k["c_w"]) * (k["beta"] * k["G"] - heating)
    return {
        "T_g": (_sensible_heat(k) + heating + latent) / k["c_g"],
        "T_p": (absorbed + flow * (k["T_h"] - k["T_p"])) / k["V_p"],
        "T_s": _soil(k),
        "C": _carbon(k),
        "V": (E - ventilation(k) * (k["V"] - k["V_o"]) - M_c) / k["h_g"],
    }


def ventilation(k: Known) -> Symbol:
    """Return phi_v, the exchange of air with outdoors, m^3/(m^2 s)."""
    leeward = k["sigma"] * k["r_l"] / (1 + k["chi"] * k["r_l"])
    return (leeward + k["zeta"] + k["xi"] * k["r_w"]) * k["w"] + k["psi"]


def pipe_exchange(k: Known) -> Symbol:
    """Return alpha, W/(m^2 K), which grows with the difference of temperature."""
    return k["nu"] * casadi.sqrt(k["tau"] + _power(k["T_g"] - k["T_p"], 0.5))


def saturation(T: Symbol, k: Known) -> Symbol:
    """Return the vapour pressure p* of saturated air, kPa; below T = -0.9 a3 the pole at -a3 is left out."""
    return k["a1"] * casadi.exp(k["a2"] * T / casadi.fmax(k["a3"] + T, 0.1 * k["a3"]))


def vapour_pressure(k: Known) -> Symbol:
    """Return p_v of the air indoors, kPa."""
    return k["lam"] * (k["T_g"] + k["T0"]) * k["V"]


def latent_heat(k: Known) -> Symbol:
    """Return ell, J/kg."""
    return k["l1"] - k["l2"] * k["T_g"]


def leaf_conductance(k: Known) -> Symbol:
    """Return g_l, m/s: light opens stomata, CO2 closes them."""
    return k["g1"] * (1 - k["g2"] * casadi.exp(-k["g3"] * k["G"])) * casadi.exp(-k["g4"] * carbon_dioxide(k))


def transpiration(k: Known) -> Symbol:
    """Return E, kg/(m^2 s), by Penman and Monteith; the fraction times g_l/g_l, so that closed stomata are no pole."""
    T, g_l, gamma = k["T_g"], leaf_conductance(k), k["gamma"]
    slope = k["s1"] * T**2 + k["s2"] * T + k["s3"]
    deficit = saturation(T, k) - vapour_pressure(k)
    demand = slope * k["eta"] * k["G"] + k["rho_a"] * k["c_a"] * deficit * k["g_b"]
    return demand * g_l / (latent_heat(k) * ((slope + gamma) * g_l + gamma * k["g_b"]))


def cover_temperature(k: Known) -> Symbol:
    """Return T_c, degC, between outdoors and indoors."""
    return (k["eps"] * k["T_o"] + k["T_g"]) / (1 + k["eps"])


def humidity_ratio(p: Symbol, k: Known) -> Symbol:
    """Return W, kg of water per kg of dry air; above 99 % of p_atm the pole at p_atm is left out."""
    return k["omega"] * p / casadi.fmax(k["p_atm"] - p, 0.01 * k["p_atm"])


def condensation(k: Known) -> Symbol:
    """Return M_c, kg/(m^2 s), on a cover whose air would be supersaturated."""
    T_c = cover_temperature(k)
    excess = humidity_ratio(vapour_pressure(k), k) - humidity_ratio(saturation(T_c, k), k)
    return k["m1"] * _power(k["T_g"] - T_c, k["m2"]) * casadi.fmax(excess, 0)


def carbon_dioxide(k: Known) -> Symbol:
    """Return c_ppm, indoors."""
    return k["R_g"] * (k["T_g"] + k["T0"]) * k["C"] / (k["p_atm"] * k["M_C"])


def respiration(k: Known) -> Symbol:
    """Return R of crop and soil, g CO2/(m^2 s)."""
    return -k["p1"] - k["p5"]


def photosynthesis(k: Known) -> Symbol:
    """Return P, g CH2O/(m^2 s)."""
    leaves = _raised(casadi.fmax(k["W_L"] / k["w_r"], 1e-9), k["l_m"])
    light = k["eta"] * k["m_p"] * k["p_par"] * k["G"]
    co2 = casadi.fmax(carbon_dioxide(k), 0)
    return k["p_m"] * leaves / (1 + leaves) * light / (k["p3"] + light) * co2 / (k["p4"] + co2)


def _sensible_heat(k: Known) -> Symbol:
    """Return what outdoors, soil and sun give to the air, W/m^2."""
    k_v = k["rho_a"] * k["c_a"] * ventilation(k)
    return (k_v + k["k_r"]) * (k["T_o"] - k["T_g"]) + k["k_s"] * (k["T_s"] - k["T_g"]) + k["eta"] * k["G"]


def _soil(k: Known) -> Symbol:
    return (k["k_s"] * (k["T_g"] - k["T_s"]) + k["k_d"] * (k["T_d"] - k["T_s"])) / k["c_s"]


def _carbon(k: Known) -> Symbol:
    exchange = ventilation(k) * (k["C_o"] - k["C"])
    return (exchange + k["k_inj"] * k["phi_c"] + respiration(k) - k["mu"] * photosynthesis(k)) / k["h_g"]


# Crop


def crop(k: Known) -> dict[str, Symbol]:
    """Return the rates of the crop, the same in both fidelities."""
    T, D, fruit, leaves = k["T_g"], k["D"], k["W_F"], k["W_L"]
    G_F = (k["f1"] - k["f2"] * D) * _raised(k["q_g"], (T - k["T_G"]) / 10)
    G_L = G_F * k["v1"] * casadi.exp(k["v2"] * (T - k["v3"]))
    q = _raised(k["q_r"], (T - k["T_R"]) / 10)
    r_F, r_L = k["M_F"] * q, k["M_L"] * q
    b = -casadi.expm1(casadi.fmin(-k["b1"] * k["B"], 1))  # 1: demand is met; below 0: overdrawn, within a step
    d = development(k)
    h = (D >= 1) * casadi.fmax(d, 0)  # harvest rate, 1/s
    demand = (k["f"] * G_F + r_F) * fruit + (k["v"] * G_L + r_L) * leaves / k["z"]
    return {
        "B": photosynthesis(k) - b * demand,
        "W_F": (b * G_F - (1 - b) * r_F - h * k["y_F"]) * fruit,
        "W_L": (b * G_L - (1 - b) * r_L - h * k["y_L"]) * leaves,
        "D": d - h,
    }


def development(k: Known) -> Symbol:
    """Return d, 1/s: faster in warm air, slower with age; cold air has a floor, where the logarithm would have a pole."""
    return k["d1"] + k["d2"] * casadi.log(casadi.fmax(k["T_g"] / k["d3"], 0.05)) - k["d4"] * k["age"] / DAY


def _power(x: Symbol, exponent: Symbol) -> Symbol:
    """Return |x|^exponent, 0 < exponent < 1; within NARROW of 0 a straight line, whose slope is finite."""
    size = casadi.fabs(x)
    return casadi.fmin(size / NARROW, 1) * _raised(casadi.fmax(size, NARROW), exponent)


def _raised(base: Symbol, exponent: Symbol) -> Symbol:
    """Return a power of a positive base; compiles and runs faster than pow, which minds other bases."""
    return casadi.exp(exponent * casadi.log(base))
