"""One transition of a model as a single CasADi function, for optimisers and for C: Runge-Kutta, limits, late inputs."""

import casadi

from simulators.input_delay import delayed_inputs
from simulators.model import Model


def one_step(model: Model) -> casadi.Function:
    """Return the function (x, u, p) -> (next, y).

    Args:
        model: with states, or a static function (then `next` is empty).

    `x` are the states; `u` the inputs of this step and of the `model.past()` steps before it, oldest first, then the inputs of
    the next step that are linear between rows (`model.linear`), in one column; `p` the uncertain parameters. `next` are the
    states one `dt` later, integrated as a fit does (classical Runge-Kutta with `model.substeps`; an angle is not wrapped), `y`
    the outputs now, with the inputs that act from now on (a late one as it arrives). Both are what sensors show but for their
    lags and delays (`model.sensor_lag`, `model.sensor_delay`).

    """
    du, past = len(model.inputs), model.past()
    x, p = (casadi.MX.sym(name, len(group), 1) for name, group in (("x", model.states), ("p", model.params)))
    u = casadi.MX.sym("u", du * (past + 1) + len(model.linear), 1)
    arriving = delayed_inputs(model, u, p)
    y = model.function()(x, arriving[0].read(), p)[1]
    names = ["x", "u", "p"], ["next", "y"]
    if not model.states:
        return casadi.Function(f"{model.name}_step", [x, u, p], [casadi.MX(0, 1), y], *names)
    flow, h = model.flow(), model.dt / model.substeps
    z = flow.enter(x, p) if flow.enter is not None else x
    for piece in arriving:
        begin, middle, end = (piece.at(share) for share in (0.0, 0.5, 1.0))
        k1 = flow.rhs(z, begin, p)
        k2 = flow.rhs(z + h / 2 * k1, middle, p)
        k3 = flow.rhs(z + h / 2 * k2, middle, p)
        z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + flow.rhs(z + h * k3, end, p))
        if flow.limited:
            z = casadi.fmin(casadi.fmax(z, casadi.DM(flow.low)), casadi.DM(flow.high))
    after = flow.leave(z, p) if flow.leave is not None else z
    return casadi.Function(f"{model.name}_step", [x, u, p], [after, y], *names)
