"""The solver against dense solves over families of matrices, and each way in which it can end."""

import itertools
from collections.abc import Callable

import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st

from sb3_gae.update.conjugate_gradient import CGResult, CGStatus, conjugate_gradient

N = 8


def rotation(seed: int, n: int = N) -> th.Tensor:
    generator = th.Generator().manual_seed(seed)
    return th.linalg.qr(th.randn(n, n, generator=generator, dtype=th.float64))[0]


def with_eigenvalues(eigenvalues: th.Tensor, seed: int = 0) -> th.Tensor:
    vectors = rotation(seed, len(eigenvalues))
    matrix = vectors @ th.diag(eigenvalues.double()) @ vectors.t()
    return 0.5 * (matrix + matrix.t())


def vector(seed: int = 1, n: int = N) -> th.Tensor:
    return th.randn(n, generator=th.Generator().manual_seed(seed), dtype=th.float64)


def solve(matrix: th.Tensor, rhs: th.Tensor, max_steps: int = 10 * N, relative_tolerance: float = 1e-12) -> CGResult:
    return conjugate_gradient(lambda direction: matrix @ direction, rhs, max_steps, relative_tolerance)


def random_matrix(seed: int) -> th.Tensor:
    factor = th.randn(N, N, generator=th.Generator().manual_seed(seed), dtype=th.float64)
    return factor @ factor.t() + 0.1 * th.eye(N, dtype=th.float64)


def rank_deficient_and_damped(seed: int) -> th.Tensor:
    eigenvalues = th.cat([th.zeros(N // 2), th.linspace(1, 5, N - N // 2)])
    return with_eigenvalues(eigenvalues, seed) + 0.1 * th.eye(N, dtype=th.float64)


FAMILIES: dict[str, Callable[[int], th.Tensor]] = {
    "random": random_matrix,
    "ill-conditioned": lambda seed: with_eigenvalues(th.logspace(-5, 2, N), seed),
    "diagonal": lambda seed: th.diag(th.linspace(0.5, 4, N).double().roll(seed)),
    "rank-deficient and damped": rank_deficient_and_damped,
    "tiny": lambda seed: 1e-30 * random_matrix(seed),
    "huge": lambda seed: 1e30 * random_matrix(seed),
}
each_family = pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES.keys())


# --- Solutions ---


@each_family
@pytest.mark.parametrize("seed", range(5))
def test_solution_is_that_of_a_dense_solve(family: Callable[[int], th.Tensor], seed: int) -> None:
    matrix, rhs = family(seed), vector(seed + 10)
    solved = solve(matrix, rhs)
    expected = th.linalg.solve(matrix, rhs)
    assert solved.status is CGStatus.CONVERGED
    # The residual is small by 1e-12; the error by as much times the condition number
    tolerance = 1e-11 * float(th.linalg.cond(matrix))
    assert (solved.solution - expected).norm() <= tolerance * expected.norm()


@each_family
def test_product_is_the_operator_applied_to_the_solution_wherever_it_ends(family: Callable[[int], th.Tensor]) -> None:
    matrix, rhs = family(3), vector()
    for max_steps in (0, 1, 3, 10 * N):
        solved = solve(matrix, rhs, max_steps)
        th.testing.assert_close(solved.product, matrix @ solved.solution, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("n", [1, 2, 5, 20])
def test_as_many_steps_as_dimensions_are_enough(n: int) -> None:
    matrix, rhs = with_eigenvalues(th.linspace(1, 3, n)), vector(n=n)
    solved = solve(matrix, rhs, max_steps=n, relative_tolerance=1e-10)
    assert solved.status is CGStatus.CONVERGED
    assert solved.steps <= n
    th.testing.assert_close(solved.solution, th.linalg.solve(matrix, rhs), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("distinct", [1, 2, 3])
def test_as_many_steps_as_distinct_eigenvalues_are_needed(distinct: int) -> None:
    matrix = with_eigenvalues((th.arange(N) % distinct + 1).double())
    assert solve(matrix, vector()).steps == distinct


@each_family
@pytest.mark.parametrize("steps", [1, 2, 4])
def test_a_truncated_solve_is_the_best_in_its_krylov_space(family: Callable[[int], th.Tensor], steps: int) -> None:
    matrix, rhs = family(1), vector()
    columns = [rhs / rhs.norm()]
    for _ in range(steps - 1):
        columns.append(matrix @ columns[-1] / (matrix @ columns[-1]).norm())
    basis = th.linalg.qr(th.stack(columns, dim=1))[0]
    expected = basis @ th.linalg.solve(basis.t() @ matrix @ basis, basis.t() @ rhs)
    solved = solve(matrix, rhs, max_steps=steps)
    assert solved.steps == steps
    th.testing.assert_close(solved.solution, expected, rtol=1e-6, atol=1e-6 * expected.abs().max().item())


@each_family
def test_every_iterate_is_an_ascent_direction_and_better_than_the_one_before(family: Callable[[int], th.Tensor]) -> None:
    matrix, rhs = family(2), vector()
    values = [0.0]
    for max_steps in range(1, N // 2 + 1):
        solution = solve(matrix, rhs, max_steps).solution
        assert rhs.dot(solution) > 0
        values.append((rhs.dot(solution) - 0.5 * solution.dot(matrix @ solution)).item())
    assert all(later > earlier for earlier, later in itertools.pairwise(values))


@given(st.integers(1, 6), st.integers(0, 1000), st.floats(-12, 12), st.floats(0, 6))
def test_residual_meets_the_tolerance_when_it_says_so(n: int, seed: int, log_scale: float, log_condition: float) -> None:
    matrix = 10**log_scale * with_eigenvalues(th.logspace(0, log_condition, n), seed)
    rhs = vector(seed, n)
    solved = solve(matrix, rhs, max_steps=50 * n, relative_tolerance=1e-6)
    assert solved.status is CGStatus.CONVERGED
    assert (matrix @ solved.solution - rhs).norm() <= 1.01e-6 * rhs.norm()


# --- Preconditioning and progress ---


@each_family
@pytest.mark.parametrize("seed", range(3))
def test_a_preconditioner_does_not_change_the_solution(family: Callable[[int], th.Tensor], seed: int) -> None:
    matrix, rhs = family(seed), vector(seed)
    rough = th.diag(1.0 / matrix.diagonal())
    solved = conjugate_gradient(lambda d: matrix @ d, rhs, 10 * N, 1e-12, preconditioner=lambda r: rough @ r)
    expected = th.linalg.solve(matrix, rhs)
    assert solved.status is CGStatus.CONVERGED
    assert (solved.solution - expected).norm() <= 1e-11 * float(th.linalg.cond(matrix)) * expected.norm()
    th.testing.assert_close(solved.product, matrix @ solved.solution, rtol=1e-9, atol=1e-9)


@each_family
def test_a_perfect_preconditioner_leaves_one_step(family: Callable[[int], th.Tensor]) -> None:
    matrix, rhs = family(0), vector()
    inverse = th.linalg.inv(matrix)
    solved = conjugate_gradient(lambda d: matrix @ d, rhs, 10, preconditioner=lambda r: inverse @ r)
    assert (solved.status, solved.steps) == (CGStatus.CONVERGED, 1)
    th.testing.assert_close(solved.solution, inverse @ rhs, rtol=1e-6, atol=0.0)


@each_family
@pytest.mark.parametrize("steps", [1, 2, 3])
def test_preconditioned_iterates_ascend_and_are_those_of_the_transformed_problem(
    family: Callable[[int], th.Tensor], steps: int
) -> None:
    # With P = LL' it is plain conjugate gradient on L'AL y = L'b, and x = Ly
    matrix, rhs = family(1), vector()
    root = th.linalg.cholesky(random_matrix(7))
    solved = conjugate_gradient(lambda d: matrix @ d, rhs, steps, 0.0, preconditioner=lambda r: root @ (root.t() @ r))
    plain = solve(root.t() @ matrix @ root, root.t() @ rhs, steps, 0.0)
    assert rhs.dot(solved.solution) > 0
    assert solved.steps == plain.steps == steps
    expected = root @ plain.solution
    th.testing.assert_close(solved.solution, expected, rtol=1e-6, atol=1e-6 * expected.abs().max().item())


@each_family
@pytest.mark.parametrize("tolerance", [0.5, 0.1, 0.01])
def test_it_ends_with_the_first_step_that_brings_too_little(family: Callable[[int], th.Tensor], tolerance: float) -> None:
    matrix, rhs = family(1), vector()
    gains, total = [], 0.0
    for steps in range(1, N + 1):
        iterate = solve(matrix, rhs, steps)
        solution = iterate.solution
        gains.append((rhs.dot(solution) - 0.5 * solution.dot(matrix @ solution)).item() - total)
        total += gains[-1]
        if gains[-1] <= tolerance * total or iterate.status is CGStatus.CONVERGED:
            break
    solved = conjugate_gradient(lambda d: matrix @ d, rhs, 10 * N, 1e-12, progress_tolerance=tolerance)
    assert (solved.status, solved.steps) == (CGStatus.CONVERGED, len(gains))


# --- Scales ---


@pytest.mark.parametrize("scale", [1e-37, 1e-30, 1e-10, 1.0, 1e10, 1e30, 1e37])
def test_in_single_precision_the_right_hand_side_may_have_any_scale(scale: float) -> None:
    matrix, rhs = random_matrix(0).float() / 10, vector().float()
    rhs /= rhs.norm()
    unit, scaled = (solve(matrix, each, relative_tolerance=1e-6) for each in (rhs, rhs * scale))
    assert scaled.status is unit.status is CGStatus.CONVERGED
    th.testing.assert_close(scaled.solution.double() / scale, unit.solution.double(), rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("scale", [1e-30, 1e-10, 1e10, 1e30])
def test_in_single_precision_the_operator_may_have_any_scale(scale: float) -> None:
    matrix, rhs = random_matrix(0).float(), vector().float()
    unit, scaled = (solve(each, rhs, relative_tolerance=1e-6) for each in (matrix, matrix * scale))
    assert scaled.status is unit.status is CGStatus.CONVERGED
    th.testing.assert_close(scaled.solution.double() * scale, unit.solution.double(), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("exponent", [-99, -1, 1, 99])
def test_a_power_of_two_scales_the_solution_exactly(exponent: int) -> None:
    matrix, rhs = random_matrix(0), vector()
    expected = solve(matrix, rhs, max_steps=3)
    scaled = solve(matrix, rhs * 2.0**exponent, max_steps=3)
    assert th.equal(scaled.solution, expected.solution * 2.0**exponent)
    assert th.equal(scaled.product, expected.product * 2.0**exponent)


# --- Endings ---


def test_it_says_when_the_steps_ran_out() -> None:
    solved = solve(with_eigenvalues(th.linspace(1, 9, N)), vector(), max_steps=2)
    assert (solved.status, solved.steps) == (CGStatus.MAX_STEPS, 2)


def test_no_steps_give_no_solution() -> None:
    solved = solve(random_matrix(0), vector(), max_steps=0)
    assert (solved.status, solved.steps) == (CGStatus.MAX_STEPS, 0)
    assert not solved.solution.any()


def test_a_zero_gradient_asks_for_no_product() -> None:
    def never(direction: th.Tensor) -> th.Tensor:
        raise AssertionError("no product is needed")

    solved = conjugate_gradient(never, th.zeros(N), 10)
    assert (solved.status, solved.steps) == (CGStatus.ZERO_GRADIENT, 0)
    assert not solved.solution.any()
    assert not solved.product.any()


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_a_gradient_that_is_not_finite_asks_for_no_product(bad: float) -> None:
    def never(direction: th.Tensor) -> th.Tensor:
        raise AssertionError("no product is needed")

    rhs = vector()
    rhs[3] = bad
    solved = conjugate_gradient(never, rhs, 10)
    assert (solved.status, solved.steps) == (CGStatus.NON_FINITE, 0)
    assert not solved.solution.any()


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("good_products", [0, 1, 3])
def test_a_product_that_is_not_finite_ends_it_with_a_finite_iterate(bad: float, good_products: int) -> None:
    matrix, rhs, products = random_matrix(0), vector(), []

    def operator(direction: th.Tensor) -> th.Tensor:
        product = matrix @ direction
        if len(products) == good_products:
            product[2] = bad
        products.append(product)
        return product

    solved = conjugate_gradient(operator, rhs, 10)
    assert solved.status is CGStatus.NON_FINITE
    assert solved.steps == good_products
    assert len(products) == good_products + 1
    assert th.equal(solved.solution, solve(matrix, rhs, max_steps=good_products).solution)


@pytest.mark.parametrize(
    "matrix",
    [-th.eye(N).double(), th.zeros(N, N).double(), with_eigenvalues(-th.linspace(1, 3, N))],
    ids=["minus one", "zero", "negative definite"],
)
def test_without_positive_curvature_at_the_start_there_is_no_solution(matrix: th.Tensor) -> None:
    solved = solve(matrix, vector())
    assert (solved.status, solved.steps) == (CGStatus.NON_POSITIVE_CURVATURE, 0)
    assert not solved.solution.any()
    assert not solved.product.any()


def test_a_gradient_in_the_null_space_of_a_singular_matrix_has_no_solution() -> None:
    matrix = th.diag(th.tensor([1.0, 1.0, 0.0], dtype=th.float64))
    solved = solve(matrix, th.tensor([0.0, 0.0, 2.0], dtype=th.float64))
    assert (solved.status, solved.steps) == (CGStatus.NON_POSITIVE_CURVATURE, 0)


def test_a_singular_matrix_with_the_gradient_in_its_range_is_solved() -> None:
    matrix = with_eigenvalues(th.tensor([0.0, 0.0, 1.0, 2.0, 3.0]))
    rhs = matrix @ vector(n=5)
    solved = solve(matrix, rhs, relative_tolerance=1e-10)
    assert solved.status is CGStatus.CONVERGED
    th.testing.assert_close(solved.solution, th.linalg.pinv(matrix) @ rhs, rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("lowest", [-0.5, 0.0])
def test_curvature_that_is_not_positive_is_met_later_and_the_iterate_before_it_is_kept(lowest: float) -> None:
    matrix = th.diag(th.tensor([1.0, 2.0, 3.0, lowest], dtype=th.float64))
    rhs = th.tensor([1.0, 1.0, 1.0, 0.3], dtype=th.float64)
    solved = solve(matrix, rhs)
    assert solved.status is CGStatus.NON_POSITIVE_CURVATURE
    assert 0 < solved.steps < 4
    assert solved.solution.norm() < 100
    before = solve(matrix, rhs, max_steps=solved.steps)
    assert before.status is CGStatus.MAX_STEPS
    assert th.equal(solved.solution, before.solution)
    assert rhs.dot(solved.solution) > 0
    th.testing.assert_close(solved.product, matrix @ solved.solution)


def test_arguments_are_not_modified() -> None:
    matrix, rhs = random_matrix(0), vector()
    matrix_before, rhs_before = matrix.clone(), rhs.clone()
    solve(matrix, rhs)
    assert th.equal(matrix, matrix_before)
    assert th.equal(rhs, rhs_before)


def test_the_operator_may_return_its_argument_itself() -> None:
    # The identity: a product that shares memory with the direction must not be written to
    rhs = vector()
    solved = conjugate_gradient(lambda direction: direction, rhs, 5)
    assert (solved.status, solved.steps) == (CGStatus.CONVERGED, 1)
    th.testing.assert_close(solved.solution, rhs)
