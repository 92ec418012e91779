# pyright: reportArgumentType=false, reportOperatorIssue=false
"""What solvers refuse, and how."""

import optax
import optimistix as optx
import pytest

from vertax import solvers

pytestmark = pytest.mark.usefixtures("without_type_checks")


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: solvers.GradientDescent(-1.0), ValueError, "`learning_rate` must be positive"),
        (lambda: solvers.GradientDescent("a"), TypeError, "`learning_rate` must hold real numbers"),
        (
            lambda: solvers.GradientDescent(float("nan")),
            ValueError,
            "`learning_rate` must be positive",
        ),
        (lambda: solvers.Optax("adam"), TypeError, r"such as optax.adam\(1e-2\), but is 'adam'"),
        (lambda: solvers.Optax(optax.adam), TypeError, "must be an Optax optimiser"),
        (lambda: solvers.LBFGS(0), ValueError, "`history` must be at least 1"),
        (lambda: solvers.LBFGS(1.5), TypeError, "`history` must be at least 1 .a Python integer."),
        (lambda: solvers.FIRE(0.0), ValueError, "`time_step` must be positive"),
        (lambda: solvers.FIRE(0.5, 0.1), ValueError, "at most `max_time_step`.* 0.5 and 0.1"),
        (lambda: solvers.FIRE(max_displacement="a"), TypeError, "`max_displacement` must"),
        (lambda: solvers.Wrapped("bfgs"), TypeError, r"but is 'bfgs'. Pass .* such as LBFGS\(\)"),
        (lambda: solvers.Wrapped(optx.BFGS), TypeError, "the class BFGS. Call it: BFGS"),
        (
            lambda: solvers.Wrapped(optax.adam(1e-2)),
            TypeError,
            r"vertax.solvers.Optax\(optimiser\)",
        ),
        (
            lambda: solvers.Wrapped(optx.LevenbergMarquardt(rtol=1e-3, atol=1e-3)),
            TypeError,
            "LevenbergMarquardt solves another kind of problem",
        ),
    ],
)
def test_arguments_of_solvers_are_checked(make, error, message):
    with pytest.raises(error, match=message):
        make()
