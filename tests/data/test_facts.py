"""Facts that are found in trajectories, on motions that are known in closed form."""

from itertools import islice

import numpy as np
import pytest

from nmpm.data.boundaries import domain_fact
from nmpm.data.convert import ForeignDataset, Options, convert, open_dataset
from nmpm.data.convert.conversion import write_native
from nmpm.data.facts import FactFinder, FoundFacts, find_facts
from nmpm.data.format import Metadata, Split, Trajectory, read_metadata, write_split
from nmpm.data.scene_inference import infer_scene
from nmpm.data.statistics import roundest
from nmpm.errors import ConfigError, DataError

PLACEHOLDERS = Metadata(((0.0, 1.0),) * 2, 1.0, 2, 0, {})
EVERYTHING = frozenset(
    {"bounds", "dt", "gravity", "static_types", "boundary", "particle_volume", "particle_types", "sequence_length"}
)
SPACING = 0.1


def block(rng: np.random.Generator, side: int = 12, dim: int = 2, jitter: float = 0.0) -> np.ndarray:
    """(N, D) particles on a lattice, or near it, around the middle of a box of 10."""
    axis = SPACING * np.arange(side)
    points = np.stack(np.meshgrid(*[axis] * dim), axis=-1).reshape(-1, dim)
    return points + rng.uniform(4, 5, dim) + jitter * SPACING * rng.uniform(-1, 1, points.shape)


def thrown(rng: np.random.Generator, gravity: tuple[float, ...], frames: int = 60, dt: float = 0.1) -> np.ndarray:
    """(T, N, D) positions of a block in a box of 10, whose particles lose half of their speed at walls."""
    start, dim = block(rng, side=5 if len(gravity) == 3 else 12, dim=len(gravity)), len(gravity)
    position, velocity = start.copy(), rng.uniform(-3, 3, dim) + rng.normal(scale=0.01, size=start.shape)
    path = [start]
    for _ in range(frames - 1):
        position = position + velocity * dt + 0.5 * np.array(gravity) * dt**2
        velocity = velocity + np.array(gravity) * dt
        outside = (position < 0) | (position > 10)
        position, velocity = np.clip(position, 0, 10), np.where(outside, -velocity / 2, velocity)
        path.append(position)
    return np.stack(path)


def facts_of(*positions: np.ndarray, types: np.ndarray | None = None, **fields: np.ndarray) -> FoundFacts:
    finder = FactFinder(positions[0].shape[2])
    for position in positions:
        kinds = np.zeros(position.shape[1], int) if types is None else types
        finder.add(Trajectory(position, kinds, {}, fields))
    return finder.facts()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def noisy(rng: np.random.Generator, run: np.ndarray, scale: float = 5e-4) -> np.ndarray:
    return run + rng.normal(scale=scale, size=run.shape)


def start_at_rest(rng: np.random.Generator, run: np.ndarray) -> np.ndarray:
    del rng
    return np.concatenate([np.repeat(run[:1], 20, axis=0), run])


def push_most(rng: np.random.Generator, run: np.ndarray) -> np.ndarray:
    run[:, 50:] += np.arange(30)[:, None, None] ** 2 * rng.uniform(0, 0.1, run[0, 50:].shape)
    return run


def collide_soon(rng: np.random.Generator, run: np.ndarray) -> np.ndarray:
    collision = rng.uniform(3, 8, run.shape[1])
    return run + np.maximum(np.arange(30)[:, None] - collision, 0)[..., None] * [0, 0.05]


class TestGravity:
    @pytest.mark.parametrize("gravity", [(0.0, -2.0), (1.5, 0.0), (0.0, 0.0, 2.0)])
    def test_direction_sign_and_size_from_thrown_blocks(self, rng, gravity):
        runs = [thrown(rng, gravity, frames=30) for _ in range(4)]
        fact = facts_of(*runs, time=0.1 * np.arange(30)).gravity
        assert fact.value == pytest.approx(gravity, abs=2e-3)
        assert fact.sure == "measured"
        assert "4 of 4 trajectories" in fact.how

    @pytest.mark.parametrize(
        ("disturb", "error", "sure", "how"),
        [
            (noisy, 0.02, None, ""),
            (push_most, 0.01, "likely", "others collide"),
            (collide_soon, 0.005, "measured", ""),  # from the few frames before
            (start_at_rest, 0.02, None, "at any time"),
        ],
    )
    def test_from_some_particles_or_some_frames(self, rng, disturb, error, sure, how):
        runs = [thrown(rng, (0.0, -2.0), frames=30) for _ in range(3)]
        runs = [disturb(rng, run) for run in runs]
        fact = facts_of(*runs, time=0.1 * np.arange(len(runs[0]))).gravity
        assert fact.value == pytest.approx((0.0, -2.0), abs=error)
        assert sure in (None, fact.sure)
        assert how in fact.how

    def test_is_none_where_particles_fly_straight(self, rng):
        fact = facts_of(*[thrown(rng, (0.0, 0.0)) for _ in range(3)]).gravity
        assert (fact.value, fact.sure) == ((0.0, 0.0), "measured")

    def test_is_unknown_where_particles_start_at_rest_under_noise_and_where_it_differs(self, rng):
        runs = [np.repeat(block(rng)[None], 40, axis=0) for _ in range(3)]
        for run in runs:
            run[20:] += np.cumsum(rng.normal(scale=0.02, size=(20, *run.shape[1:])), axis=0)
        noise = [noisy(rng, thrown(rng, (0.0, -2.0), frames=30), 0.5) for _ in range(3)]
        pulls = ((0.0, -2.0), (2.0, 0.0), (0.0, 2.0), (-2.0, 0.0))
        differing = [thrown(rng, gravity, frames=20) for gravity in pulls]
        for unknown, how in ((runs, "at rest in first frames"), (noise, ""), (differing, "differs")):
            fact = facts_of(*unknown).gravity
            assert fact.value is None
            assert how in fact.how


class TestBounds:
    def test_walls_that_are_touched_in_several_trajectories(self, rng):
        facts = facts_of(*[thrown(rng, (0.0, -2.0), frames=120) for _ in range(8)])
        (left, right), (floor, top) = facts.bounds.value
        assert (left, right, floor) == pytest.approx((0.0, 10.0, 0.0), abs=1e-6)
        assert top > 6
        assert "x: particles stop or turn at 0 (" in facts.bounds.how
        assert facts.boundary.value == ("wall", "wall")

    def test_a_free_block_touches_nothing(self, rng):
        facts = facts_of(*[thrown(rng, (0.0, -1.0), frames=8) for _ in range(3)])
        assert facts.bounds.sure == facts.boundary.sure == "guessed"
        assert "stop or turn" not in facts.bounds.how

    def test_a_period_from_jumps(self, rng):
        start = rng.uniform(0, 1, (300, 2)) * (4, 1)
        path = start + np.arange(40)[:, None, None] * rng.normal((0.12, 0.0), (0.02, 0.001), start.shape)
        path[..., 0] = np.mod(path[..., 0] + 2, 4) - 2
        facts = facts_of(path)
        assert facts.boundary.value == ("periodic", "wall")
        assert facts.bounds.value[0] == (-2.0, 2.0)

    def test_particles_that_are_put_back_elsewhere_do_not_wrap(self, rng):
        path = rng.uniform(0, 1, (300, 2)) + np.arange(40)[:, None, None] * np.array([0.024, 0.0])
        again = path[..., 0] > 1
        path[..., 0] = np.mod(path[..., 0], 1)
        path[..., 1] = np.where(again, rng.uniform(0, 1, path.shape[1]), path[..., 1])
        assert "periodic" not in facts_of(path).boundary.value

    def test_open_where_tracks_end_at_one_end(self, rng):
        path = rng.uniform(0, 1, (400, 2)) * (4, 1) + np.arange(60)[:, None, None] * np.array([0.08, 0.0])
        path[path[..., 0] > 4] = np.nan
        facts = facts_of(path)
        assert facts.boundary.value == ("open", "wall")
        assert facts.bounds.value[0] == pytest.approx((0, 4), abs=0.05)

    def test_open_everywhere_where_tracks_begin_and_end_anywhere(self, rng):
        path = rng.uniform(0, 1, (400, 3)) + np.cumsum(rng.normal(scale=0.01, size=(60, 400, 3)), axis=0)
        first, last = np.sort(rng.integers(0, 60, (2, 400)), axis=0)
        frame = np.arange(60)[:, None]
        path[(frame < first) | (frame > last)] = np.nan
        assert facts_of(path).boundary.value == ("open",) * 3


class TestDomain:
    @pytest.mark.parametrize("bounds", [((0, 10), (0, 10)), ((0, 20), (-0.5, 1)), ((0, 1), (0, 2), (0, 3))])
    def test_has_a_cell_of_wall_and_whole_cells(self, bounds):
        fact = domain_fact(bounds, ("wall",) * len(bounds), None, spacing=0.1)
        sides = np.diff(fact.value).ravel()
        cells = next(count for count in range(8, 513, 8) if f"about {count} cells" in fact.how)
        cell = sides.max() / cells
        assert sides / cell == pytest.approx(np.round(sides / cell), abs=0.01)
        for (low, high), (outer_low, outer_high) in zip(bounds, fact.value, strict=True):
            assert 0.99 * cell < low - outer_low < 1.52 * cell
            assert 0.99 * cell < outer_high - high < 1.52 * cell

    def test_contains_obstacles_and_ends_with_other_boundaries(self):
        bounds = ((0.0, 4.0), (0.0, 2.0), (0.0, 2.0))
        obstacles = ((0.0, 4.0), (0.0, 2.0), (-1.0, 2.0))
        domain = domain_fact(bounds, ("periodic", "open", "wall"), obstacles, spacing=0.1).value
        assert domain[:2] == bounds[:2]
        assert domain[2][0] <= -1


class TestTypes:
    def test_static_and_rigid_types_and_particles_that_never_move(self, rng):
        fluid = thrown(rng, (0.0, -2.0), frames=40)
        fluid[:, :3] = fluid[:1, :3]
        wall = np.repeat(rng.uniform(0, 10, (1, 30, 2)), 40, axis=0)
        angle = 0.1 * np.arange(40)
        turn = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], -1).reshape(40, 2, 2)
        paddle = np.einsum("tij,nj->tni", turn, rng.uniform(-1, 1, (20, 2))) + 5
        types = np.repeat([4, 2, 7], [fluid.shape[1], 30, 20])
        facts = facts_of(np.concatenate([fluid, wall, paddle], axis=1), types=types)
        assert facts.static_types.value == {2}
        assert facts.prescribed_types.value == {7}
        assert facts.particle_types.value == {2: "boundary", 4: "particles", 7: "moving boundary"}
        still = facts.unmoving
        assert (still.trajectory, still.particle, still.count) == (0, 0, 3)

    def test_rigid_bodies_that_fall_or_differ_between_trajectories_are_free(self, rng):
        def run(shift, dt=0.1):
            fluid = thrown(rng, (0.0, -2.0), frames=40, dt=dt)
            return np.concatenate([fluid, rng.uniform(4, 5, (1, 20, 2)) + shift], axis=1)

        types, time = np.repeat([0, 7], [144, 20]), 0.1 * np.arange(40)[:, None, None]
        falling = time**2 * [0, -1.0]
        assert facts_of(run(falling), types=types).prescribed_types.value == frozenset()
        clips = [run(falling / 25 + phase * time, dt=0.02) for phase in range(4)]
        assert facts_of(*clips, types=types).prescribed_types.value == frozenset()
        differing = [run(np.sin(phase + time) * [0, 1.0]) for phase in (0.0, 1.0)]
        fact = facts_of(*differing, types=types).prescribed_types
        assert fact.value == frozenset()
        assert "type 7 is rigid" in fact.how
        paddles = [run(np.sin(time) * [0, 1.0]) for _ in range(2)]
        assert facts_of(*paddles, types=types).prescribed_types.value == {7}

    def test_nothing_is_static_where_nothing_moves(self, rng):
        facts = facts_of(np.repeat(block(rng)[None], 5, axis=0))
        assert facts.static_types.value == facts.prescribed_types.value == frozenset()
        assert facts.particle_types.value == {0: "particles"}


class TestVolume:
    @pytest.mark.parametrize("dim", [2, 3])
    @pytest.mark.parametrize("jitter", [0.0, 0.25])
    def test_of_lattices(self, rng, dim, jitter):
        start = block(rng, side=30 if dim == 2 else 14, dim=dim, jitter=jitter)
        fact = facts_of(np.stack([start, start + 1])).particle_volume
        assert fact.value == pytest.approx(SPACING**dim, rel=0.05)

    @pytest.mark.parametrize("dim", [2, 3])
    def test_of_particles_at_random_places_in_blocks(self, rng, dim):
        start = np.concatenate([rng.uniform(0, 1, (900, dim)), rng.uniform(3, 4, (900, dim))])
        fact = facts_of(np.stack([start, start + 1])).particle_volume
        assert fact.value == pytest.approx(1 / 900, rel=0.1)
        assert "on a lattice would give" in fact.how


G = np.array([0.0, -9.81])
FORCES = {
    "gravity": (lambda x, v: G + 0 * v, None, None),
    "gravity, thrown up": (lambda x, v: G + 0 * v, (0.0, 2.0), None),
    "gravity, from rest": (lambda x, v: G + 0 * v, (0.0, 0.0), None),
    "drag": (lambda x, v: -1.5 * v, (3.0, 1.0), "opposite to their velocity, as friction and drag"),
    "sliding": (lambda x, v: -3 * v / np.linalg.norm(v, axis=1, keepdims=True), (3.0, 1.0), "friction"),
    "gravity and drag": (lambda x, v: G - 1.0 * v, (3.0, 1.0), "changes with their velocity, as drag"),
    "a spring": (lambda x, v: -4 * (x - np.array([20.0, 5.0])), (0.0, 0.0), "changes with their place, as a spring"),
}


@pytest.mark.parametrize("noise", [0.0, 1e-4])
@pytest.mark.parametrize("force", FORCES)
def test_what_speaks_against_gravity_is_said(rng, force, noise):
    accelerate, thrown_with, against = FORCES[force]
    finder, dt = FactFinder(2), 0.01
    for _ in range(3):
        x = block(rng)
        v = rng.normal(scale=0.01, size=x.shape) + (rng.uniform(-3, 3, 2) if thrown_with is None else thrown_with)
        path = [x]
        for _ in range(59 * 10):
            v = v + dt / 10 * accelerate(x, v)
            x = x + dt / 10 * v
            path.append(x)
        run = np.stack(path[::10]) + noise * rng.normal(size=(60, *x.shape))
        finder.add(Trajectory(run.astype(np.float32), np.zeros(144, int), {}, {"time": dt * np.arange(60)}))
    gravity = finder.facts().gravity
    assert gravity.sure == ("likely" if against else "measured")
    if against:
        assert against in gravity.how
    else:
        assert gravity.value == pytest.approx(G, rel=5e-3, abs=0.05)


def test_a_flight_of_few_frames_is_compared_with_nothing(rng):
    assert facts_of(thrown(rng, (0.0, -2.0), frames=5), thrown(rng, (0.0, -2.0), frames=5)).gravity.value is not None


class TestTime:
    def test_median_of_recorded_steps_and_a_word_on_uneven_ones(self, rng):
        run = thrown(rng, (0.0, -2.0), frames=20)
        assert facts_of(run, time=0.25 * np.arange(20)).dt.value == 0.25
        uneven = np.where(np.arange(20) < 15, 0.25, 0.5).cumsum()
        assert "uneven" in facts_of(run, time=uneven).dt.how

    def test_from_velocities(self, rng):
        run = thrown(rng, (0.0, -2.0), frames=20)
        velocity = np.gradient(run, axis=0) / 0.04
        assert facts_of(run, velocity=velocity).dt.value == pytest.approx(0.04, rel=2e-3)
        backward = np.diff(run, axis=0, prepend=run[:1]) / 0.04
        assert facts_of(run, velocity=backward).dt.value == pytest.approx(0.04, rel=1e-6)
        assert facts_of(run, velocity=velocity * 0.04, time=0.1 * np.arange(20)).dt.value == 0.1

    @pytest.mark.parametrize("step", [0.01, 1 / 240, 0.3333, 100.0])
    def test_velocities_never_overrule_recorded_times_but_tell_how_long_a_numbered_step_is(self, rng, step):
        run = thrown(rng, (0.0, -2.0), frames=20)
        velocity, time = np.gradient(run, axis=0) / 0.04, step * np.arange(20)
        assert facts_of(run, velocity=velocity, time=time).dt.value == pytest.approx(step, rel=1e-12)
        for fields, dt in (({}, step), ({"velocity": velocity}, 0.04)):
            finder = FactFinder(2, steps=True)
            finder.add(Trajectory(run, np.zeros(144, int), {}, {"time": time} | fields))
            assert finder.facts().dt.value == pytest.approx(dt, rel=2e-3)


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [(0.98, 1.02, 1.0), (-0.03, 0.02, 0.0), (119, 131, 120), (-30.2, -29.7, -30), (1, 1, 1)],
)
def test_the_roundest_number_of_an_interval(low, high, expected):
    assert roundest(low, high) == expected


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("particles", [1, 2, 50])
def test_few_frames_and_particles_suffice(rng, frames, particles):
    position = rng.uniform(size=(frames, particles, 2))
    position[-1, 1:] = np.nan
    facts = facts_of(position, time=np.arange(frames))
    assert all(low < high for low, high in facts.bounds.value)
    assert facts.gravity.value is None


def test_absent_particles_everywhere_are_an_error():
    with pytest.raises(DataError, match="no trajectory has a particle"):
        FactFinder(2).facts()


class TestConversion:
    def test_bare_positions_become_a_scene(self, rng, tmp_path):
        positions = [thrown(rng, (0.0, -2.0)) for _ in range(3)]
        positions[0][:, :3] = positions[0][0, :3]
        runs = [Trajectory(each, np.full(144, 4), {}, {"time": 0.1 * np.arange(60)}) for each in positions]
        source = ForeignDataset(PLACEHOLDERS, {"train": lambda: iter(runs)}, unknown=EVERYTHING)
        notes = write_native(source, tmp_path / "a")
        metadata = read_metadata(tmp_path / "a")
        assert metadata.dt == pytest.approx(0.1)
        assert metadata.particle_types == {4: "particles"}
        assert metadata.sequence_length == 59
        assert set(metadata.extra["found"]) >= EVERYTHING
        assert not any("sequence_length" in note or "((" in note for note in notes)
        assert any("gravity 0, -2 (measured: free flight" in note for note in notes)
        assert any(
            "3 particles of moving types never move (in trajectory 0, e.g. particle 0)" in note for note in notes
        )
        scene = infer_scene(tmp_path / "a")
        assert scene.materials == ("particles",)
        assert scene.gravity == pytest.approx((0.0, -2.0), abs=1e-3)

    def test_statistics_are_those_of_the_types_that_are_found_to_move(self, rng, tmp_path):
        fluid = thrown(rng, (0.0, -2.0))
        position = np.concatenate([fluid, np.repeat(block(rng)[None], 60, axis=0)], axis=1)
        run = Trajectory(position, np.repeat([0, 1], 144))
        unknown = ForeignDataset(PLACEHOLDERS, {"train": lambda: iter([run])}, unknown=EVERYTHING)
        write_native(unknown, tmp_path / "a")
        metadata = read_metadata(tmp_path / "a")
        assert metadata.static_types == {1}
        assert metadata.extra["vel_mean"] == pytest.approx(np.diff(fluid, axis=0).mean((0, 1)).tolist(), rel=1e-3)

    def test_stated_facts_win(self, rng, tmp_path):
        np.savez(tmp_path / "a.npz", positions=np.stack([thrown(rng, (0.0, -2.0)) for _ in range(3)]))
        options = Options(gravity=(0.0, -7.0), boundary=("periodic", "wall"), dt=0.5, types={0: "jelly"})
        convert(tmp_path / "a.npz", tmp_path / "b", options=options)
        metadata, scene = read_metadata(tmp_path / "b"), infer_scene(tmp_path / "b")
        assert (metadata.dt, metadata.gravity, scene.materials) == (0.5, (0.0, -7.0), ("jelly",))
        assert scene.domain[0] == scene.bounds[0]
        assert {"gravity", "dt", "boundary"}.isdisjoint(metadata.extra["found"])

    @pytest.mark.parametrize(("types", "how"), [({0: "jelly", 1: "sand"}, None), ({0: "jelly"}, "those of type 1")])
    def test_names_that_the_user_states_are_not_called_guessed(self, rng, tmp_path, types, how):
        np.savez(tmp_path / "a.npz", positions=thrown(rng, (0.0, -2.0))[None], types=np.repeat([0, 1], 72))
        notes = convert(tmp_path / "a.npz", tmp_path / "b", options=Options(types=types))
        assert [note for note in notes if "particle_types" in note and how is None] == []
        assert how is None or any(f"guessed: {how} by their ids" in note for note in notes)

    def test_types_without_names_are_renumbered(self, rng, tmp_path):
        runs = np.stack([thrown(rng, (0.0, -2.0)) for _ in range(3)])
        np.savez(tmp_path / "a.npz", positions=runs, types=np.repeat([0, 1], 72))
        convert(tmp_path / "a.npz", tmp_path / "b", ids={0: 5})
        assert read_metadata(tmp_path / "b").particle_types == {1: "type1", 5: "type5"}
        with pytest.raises(ConfigError, match="type 1 occurs"):
            convert(tmp_path / "a.npz", tmp_path / "c", ids={0: 1})

    def test_gravities_of_trajectories_are_kept(self, rng, tmp_path):
        run = Trajectory(thrown(rng, (0.0, -2.0)), np.zeros(144, int), {"gravity": [0.0, -5.0]})
        write_native(ForeignDataset(PLACEHOLDERS, {"train": lambda: iter([run])}, unknown=EVERYTHING), tmp_path / "a")
        assert read_metadata(tmp_path / "a").gravity is None
        assert infer_scene(tmp_path / "a").gravity == (0.0, -5.0)


def test_facts_of_a_split_in_the_units_that_metadata_state(rng, tmp_path):
    write_split(tmp_path / "train.h5", [Trajectory(thrown(rng, (0.0, -2.0)), np.zeros(144, int)) for _ in range(3)])
    split = Split(tmp_path / "train.h5")
    assert find_facts(split).gravity.value == pytest.approx((0.0, -0.02), abs=1e-4)
    stated = Metadata(((0.0, 10.0),) * 2, 0.1, 2, 59, {0: "sand"})
    assert find_facts(split, stated).gravity.value == pytest.approx((0.0, -2.0), abs=1e-2)


@pytest.mark.parametrize(
    ("folder", "dt", "gravity", "boundary"),
    [
        ("lammps-grains", 1.0, (0.0, -0.00981), ("wall", "wall")),
        ("taichi-mpm128", 1.0, (0.0, -30 * 0.004**2), ("wall", "wall")),
        ("warp-sph-vtk", 0.6, (0.0, -0.1, 0.0), ("wall",) * 3),
        ("ptv-tracks", 0.004, None, ("open",) * 3),
    ],
)
def test_facts_of_recordings_by_other_programs(recorded, folder, dt, gravity, boundary):
    if not (recorded / "third-party" / folder).is_dir():
        pytest.skip(f"there is no third-party/{folder}")
    if folder == "warp-sph-vtk":
        pytest.importorskip("pyvista")
    dataset = open_dataset(recorded / "third-party" / folder)
    finder = FactFinder(dataset.metadata.dim, steps=dataset.steps)
    for trajectory in islice(dataset.splits["train"](), 3):
        finder.add(trajectory)
    facts = finder.facts()
    assert facts.dt.value == pytest.approx(dt, rel=1e-3)
    assert facts.gravity.value == (None if gravity is None else pytest.approx(gravity, rel=2e-3))
    assert facts.boundary.value == boundary
    assert facts.static_types.value == ({3} if folder == "lammps-grains" else frozenset())
