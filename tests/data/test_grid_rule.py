import pytest

from nmpm.data.grid_rule import GridFacts, Machine, TrainingSize, candidates, grid_cost, grid_shape, recommended_cells

BOX = ((0.08, 0.92), (0.08, 0.92))
# Particles per occupied cell that the shipped datasets have on grids of so many cells.
GOOP = {24: 18.4, 32: 11.7, 40: 7.4, 48: 5.4, 56: 4.15, 64: 3.2, 80: 2.2}
DAM_BREAK = {72: 13.0, 80: 10.4, 96: 8.2, 128: 4.6, 144: 3.9, 192: 2.5}
CHANNEL = {24: 3.4, 32: 2.2, 40: 1.6, 48: 1.2}


def facts(per_cell, shape=lambda n: (n, n), speed=0.0):
    return [GridFacts(n, shape(n), value, 0.0, speed * n, speed * n) for n, value in per_cell.items()]


@pytest.mark.parametrize(
    ("per_cell", "shape", "particles", "minutes", "shipped"),
    [
        (GOOP, lambda n: (n, n), 2000, 15, 32),
        (DAM_BREAK, lambda n: (n, round(n * 56 / 144)), 5000, 120, 144),
        (CHANNEL, lambda n: (n, n // 2), 500, 15, 32),
    ],
)
def test_the_rule_is_near_the_shipped_configurations(per_cell, shape, particles, minutes, shipped):
    cells = recommended_cells(facts(per_cell, shape), particles, Machine(minutes=minutes))
    assert shipped / 1.3 <= cells <= 1.3 * shipped


def test_slow_machines_and_fast_particles_get_coarser_grids():
    assert recommended_cells(facts(GOOP), 2000, Machine()) == 40
    assert recommended_cells(facts(GOOP), 2000, Machine(slowness=1.1)) == 32  # 2000 steps
    assert recommended_cells(facts(GOOP, speed=0.07), 2000, Machine()) == 32  # 2.5 cells a frame
    assert recommended_cells(facts(GOOP), 2000, Machine(memory=1e6)) == 32  # none fits: the coarsest


def test_memory_bounds_grids_in_three_dimensions():
    cube = facts({16: 30.0, 24: 20.0, 48: 18.0}, lambda n: (n, n, n))
    cost = grid_cost((48, 48, 48), 2000, Machine(memory=2e9), TrainingSize.of(3))
    assert not cost.fits
    assert cost.memory == pytest.approx(2.8e9, rel=0.1)
    assert recommended_cells(cube, 2000, Machine(slowness=0.01, memory=2e9)) == 24


def test_slim_boxes_have_cells_across():
    slim = facts({40: 5.0, 56: 2.3, 72: 1.55, 88: 1.3}, lambda n: (n // 5, n, n // 5), speed=0.02)
    assert recommended_cells(slim, 2000, Machine(slowness=0.1)) == 40  # 16 across would leave 1.3 to a cell
    slim = facts({40: 5.0, 56: 2.3, 80: 1.5}, lambda n: (n // 5, n, n // 5), speed=0.02)
    assert recommended_cells(slim, 2000, Machine(slowness=0.1)) == 80


def test_candidates_are_multiples_of_eight_around_the_spacing():
    numbers = candidates(BOX, 0.00714)
    assert all(number % 8 == 0 for number in numbers)
    assert numbers[0] == 16  # half of the least
    assert numbers[-1] * 0.00714 * 1.25 == pytest.approx(0.84, rel=0.05)
    assert candidates(((0.0, 1.0),) * 3, 0.05) == (8, 16, 24, 32)


def test_shapes_are_square_and_periodic_axes_multiples_of_eight():
    assert grid_shape(((0.0, 1.0), (0.0, 0.38)), (True, False), 32) == (32, 12)
    assert grid_shape(((0.0, 1.0), (0.0, 0.38)), (False, True), 32) == (32, 16)
    assert grid_shape(((0.0, 9.0), (0.0, 0.5)), (False, False), 64) == (64, 8)
    assert grid_shape(((0.0, 9.0), (0.0, 2.5)), (False, False), 64) == (64, 16)  # 17.8, which would be padded to 24
