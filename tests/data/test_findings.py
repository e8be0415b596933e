"""Each lie about made-up data is the first finding, with its factor; data without lies have none."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nmpm.cli import main
from nmpm.data.dataset_checks import compare_domains
from nmpm.data.findings import Finding, Severity, merge_findings
from nmpm.data.format import Metadata, Trajectory, write_metadata, write_split
from nmpm.data.inspection import contradictions_warning, inspect
from nmpm.data.sources import FolderSource

DT, GRAVITY, SPACING, SIDE, FRAMES = 0.01, 9.81, 0.02, 10, 32
WALL = Metadata(
    bounds=((0.0, 1.0),) * 2,
    domain=((-0.1, 1.1),) * 2,
    dt=DT,
    dim=2,
    sequence_length=FRAMES,
    particle_types={3: "boundary", 7: "goop"},
    static_types=frozenset({3}),
    gravity=(0.0, -GRAVITY),
    particle_volume=SPACING**2,
)


@dataclass
class Data:
    """Positions (T, N, 2) and types (N,) of runs by split, and what is stated about them."""

    metadata: Metadata
    types: np.ndarray
    runs: dict[str, list[np.ndarray]]
    fields: dict[str, np.ndarray] = field(default_factory=dict)  # of all runs
    attributes: dict[str, Any] = field(default_factory=dict)  # likewise

    def change(self, change: Callable[[np.ndarray], np.ndarray], runs: slice = slice(None)) -> None:
        """Changes positions of runs of the train split."""
        self.runs["train"][runs] = [change(run.copy()) for run in self.runs["train"][runs]]

    def change_all(self, change: Callable[[np.ndarray], np.ndarray]) -> None:
        """Changes positions of all runs."""
        self.runs = {name: [change(run.copy()) for run in runs] for name, runs in self.runs.items()}

    def move(self, shift: float) -> None:
        """Moves everything."""
        self.change_all(lambda run: run + shift)
        self.state(
            bounds=tuple((low + shift, high + shift) for low, high in self.metadata.bounds),
            domain=tuple((low + shift, high + shift) for low, high in self.metadata.domain or ()),
        )

    def state(self, **changes: Any) -> None:
        """Changes the metadata."""
        self.metadata = replace(self.metadata, **changes)

    def findings(self, folder: Path) -> tuple[Finding, ...]:
        """What an inspection finds, one of each kind."""
        for name, runs in self.runs.items():
            write_split(
                folder / f"{name}.h5",
                (Trajectory(np.float32(run), self.types, self.attributes, self.fields) for run in runs),
            )
        write_metadata(folder, self.metadata)
        return merge_findings(inspect(FolderSource(folder)).findings, sum(map(len, self.runs.values())))


def reflect(flight: np.ndarray) -> np.ndarray:
    """Coordinates of particles that walls at 0 and 1 throw back."""
    return 1 - np.abs(1 - np.abs(flight))


def thrown_block(
    seed: int,
    frames: int = FRAMES,
    spacing: float = SPACING,
    within: Callable[[np.ndarray], np.ndarray] = reflect,
) -> np.ndarray:
    """Positions (T, N, 2) of a block of particles that flies through the unit square, and of a row below its floor."""
    rng = np.random.default_rng(seed)
    lattice = spacing * np.stack(np.meshgrid(*[np.arange(SIDE)] * 2, indexing="ij"), -1).reshape(1, -1, 2)
    time = DT * np.arange(frames)[:, None, None]
    start, velocity = rng.uniform((0.1, 0.6), (0.6, 0.75)), rng.uniform((-1.5, -1.0), (1.5, 1.0))
    flight = start + lattice + velocity * time - np.array([0.0, GRAVITY / 2]) * time**2
    floor = np.stack([np.linspace(0, 1, 2 * SIDE), np.full(2 * SIDE, -0.05)], -1)
    return np.concatenate([within(flight), np.broadcast_to(floor, (frames, 2 * SIDE, 2))], axis=1)


@pytest.fixture
def data() -> Data:
    splits = {"train": range(3), "valid": range(3, 4), "test": range(4, 5)}
    types = np.r_[np.full(SIDE**2, 7), np.full(2 * SIDE, 3)]
    return Data(WALL, types, {name: [thrown_block(seed) for seed in seeds] for name, seeds in splits.items()})


def test_nothing_is_found_in_data_without_lies(data, tmp_path):
    assert data.findings(tmp_path) == ()


def test_trajectories_that_state_their_volume_may_differ_in_it(data, tmp_path):
    data.change(lambda run: thrown_block(9, spacing=0.03), ONE)
    data.attributes = {"particle_volume": 0.0006}
    assert data.findings(tmp_path) == ()


def put(*where: Any, value: Any = np.nan) -> Callable[[np.ndarray], np.ndarray]:
    """A change of a run that puts particles somewhere in some frames; nowhere by default."""

    def change(run: np.ndarray) -> np.ndarray:
        for place in where:
            run[place] = value(run) if callable(value) else value
        return run

    return change


def shift(where: Any, by: Any) -> Callable[[np.ndarray], np.ndarray]:
    """A change of a run that moves particles."""
    return lambda run: put(where, value=run[where] + by)(run)


FLUID, ORDER = np.s_[:, : SIDE**2], np.random.default_rng(0).permutation(SIDE**2)
JUMP = 10 * SPACING * np.array([0.6, 0.8])
teleported, glitched = shift(np.s_[12:, 5], JUMP), shift(np.s_[12, 5], JUMP)
doubled, stuck = put(np.s_[:, 3], value=lambda run: run[:, 4]), put(np.s_[:, :10], value=lambda run: run[0, :10])
absent = put(np.s_[:6, 2], np.s_[-3:, 4])
unwritten, unwritten_within, lost = put(np.s_[-4:], value=0), put(np.s_[12], value=0), put(np.s_[20:, 5], value=1e6)
wall_moves = shift(np.s_[:, -1, 0], np.linspace(0, 0.05, FRAMES))
shuffled_once = put(np.s_[20:, : SIDE**2], value=lambda run: run[20:, ORDER])
overflowed = put(np.s_[-4:], value=lambda run: run[-4:] * 1e25)
noisy = put(FLUID, value=lambda run: run[FLUID] + np.random.default_rng(0).normal(scale=0.01, size=run[FLUID].shape))


def drifted(run: np.ndarray) -> np.ndarray:
    drift = 0.01 * np.maximum(0, np.arange(FRAMES) - 10)[:, None, None]
    return put(FLUID, value=reflect(run[FLUID] + drift))(run.copy())


def shuffled(run: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(0)
    return put(FLUID, value=np.stack([frame[rng.permutation(SIDE**2)] for frame in run]))(run)


def repeated(run: np.ndarray) -> np.ndarray:
    return np.insert(run, 8, run[8], axis=0)


def straight(run: np.ndarray) -> np.ndarray:
    steps = np.arange(len(run))[:, None, None] * (run[1, : SIDE**2] - run[0, : SIDE**2])
    return put(FLUID, value=reflect(run[0, : SIDE**2] + steps))(run)


def stream(seed: int, reset: bool, out: bool = False) -> np.ndarray:
    """Positions (T, N, 2) of a stream that comes in again as it leaves, or elsewhere (`reset`), or is gone (`out`)."""
    rng = np.random.default_rng(seed)
    position = thrown_block(seed)
    start = rng.uniform((0, 0.3), (1, 0.7), (SIDE**2, 2))
    flight = start + DT * np.arange(FRAMES)[:, None, None] * np.array([1.5, 0.0])
    turns = np.floor(flight[..., 0])
    flight[..., 0] -= turns
    flight[..., 1] += np.where(turns > 0, rng.uniform(-0.3, 0.3, SIDE**2), 0) if reset else 0
    position[:, : SIDE**2] = np.where(turns[..., None] > 0, np.nan, flight) if out else flight
    return position


def rain(seed: int, spacing: float, duration: int) -> np.ndarray:
    """Positions (T, N, 2) of grains that come from far apart to rest on a lattice, after so many frames."""
    rng = np.random.default_rng(seed)
    rest = np.float64(thrown_block(seed)[0, : SIDE**2] * 0)
    rest += spacing * np.stack(np.meshgrid(*[np.arange(SIDE)] * 2, indexing="ij"), -1).reshape(-1, 2)
    above = rest + rng.uniform((0, 0.2), (0.5, 0.7), rest.shape)
    share = np.clip(np.arange(FRAMES) / duration, 0, 1)[:, None, None] ** 2
    position = thrown_block(seed)
    position[:, : SIDE**2] = above + share * (rest - above)
    return position


def record(data: Data, time: np.ndarray, frames: np.ndarray, velocity_unit: float = 0.0) -> None:
    """Keeps some frames of all runs, at times that are recorded; with velocities, in some unit of time."""
    data.change_all(lambda run: run[frames])
    data.fields["time"] = time
    if velocity_unit:
        data.fields["velocity"] = np.gradient(data.runs["train"][0], DT / velocity_unit, axis=0)


ONE = slice(2, 3)
EVERY, TIME = np.arange(FRAMES), DT * np.arange(FRAMES)
RESTART = np.r_[0:20, 14:FRAMES]
REPEAT = np.sort(np.r_[EVERY, 9])
JITTERED = TIME + 0.02 * DT * np.random.default_rng(0).uniform(-1, 1, FRAMES)
CAUSES: dict[str, tuple[Callable[[Data], object], str]] = {
    "unwritten frames": (lambda data: data.change(unwritten, ONE), "empty frames: .*frame 28: .*4 frames"),
    "unwritten frames everywhere": (lambda data: data.change_all(unwritten), "empty frames: in 5 of 5"),
    "an unwritten frame": (lambda data: data.change(unwritten_within, ONE), "empty frames: .*frame 12: .*1 frame,"),
    "overflow": (lambda data: data.change(overflowed, ONE), "overflowed frames: .*frame 28"),
    "a lost particle": (lambda data: data.change(lost, ONE), "lost particles: .*frame 20, particle 5"),
    "restart": (lambda data: record(data, TIME[RESTART], RESTART), "uneven .*go back in frame 20, from 0.19 to 0.14"),
    "repeated times": (lambda data: record(data, TIME[REPEAT], REPEAT), "uneven .*repeat: 1 frame .* frame 10"),
    "missing frames": (lambda data: record(data, np.delete(TIME, [8, 20]), np.delete(EVERY, [8, 20])),
                       "uneven .*2 of 29 steps differ"),
    "jitter": (lambda data: data.fields.update(time=JITTERED), "uneven .*by up to 3.5% around their mean, 0.00999"),
    "dt beside velocities": (lambda data: (record(data, TIME, EVERY, 1), data.fields.pop("time"),
                                           data.state(dt=10 * DT, gravity=None)),
                             "dt: .*10 times too large: recorded velocities are displacements over 0.01"),
}  # fmt: skip
UNEVEN = DT * (np.arange(FRAMES) + (np.arange(FRAMES) > 9))
LIES: dict[str, tuple[Callable[[Data], object], str, float | None]] = {
    "gravity up": (lambda data: data.state(gravity=(0.0, GRAVITY)), "opposite direction", 1),
    "gravity along x": (lambda data: data.state(gravity=(-GRAVITY, 0.0)), "gravity: .*along x in place of y", 1),
    "gravity in mm": (lambda data: data.state(gravity=(0.0, -9810.0)), "gravity: .*1000 times too large", 1000),
    "gravity in km": (lambda data: data.state(gravity=(0.0, -0.00981)), "gravity: .*1000 times too small", 1e-3),
    "gravity by half": (lambda data: data.state(gravity=(0.0, -4.905)), "gravity: .*2 times too small.*-9.81", 0.5),
    "gravity of zero": (lambda data: data.state(gravity=(0.0, 0.0)), "gravity: .*there is one", None),
    "gravity where there is none": (lambda data: data.change_all(straight), "fly straight.*--gravity=0,0", None),
    "dt": (lambda data: data.state(dt=2.5 * DT), "dt: .*2.5 times too large.*--dt 0.01", 2.5),
    "dt of frames": (lambda data: data.state(dt=1.0), "dt: .*100 times too large", 100),
    "dt in ms": (lambda data: data.state(dt=DT / 1000), "dt: .*1000 times too small", 1e-3),
    "dt against times": (lambda data: (data.state(dt=DT / 3), data.fields.update(time=DT * np.arange(FRAMES))),
                         "dt: .*3 times too small.*recorded times.*--dt 0.01", 1 / 3),
    "uneven times": (lambda data: data.fields.update(time=UNEVEN), "uneven time steps: .*frame 10.* 1 of 31", 2),
    "volume": (lambda data: data.state(particle_volume=10 * SPACING**2), "particle volume: .*times too large", None),
    "volume of a radius": (lambda data: data.state(particle_volume=0.1 * SPACING**2), "particle volume: .*small", None),
    "bounds too small": (lambda data: data.state(bounds=((0.2, 0.8), (0.0, 1.0)), domain=None), "bounds: .*x", None),
    "bounds too large": (lambda data: data.state(bounds=((0.0, 1.0), (0.0, 50.0)), domain=None), "far bounds: .*y", 48),
    "domain too small": (lambda data: data.state(bounds=((0.2, 0.8), (0.0, 1.0)), domain=((0.2, 0.8), (-0.1, 1.1))),
                         "does not contain the positions", None),
    "walls that wrap": (lambda data: data.change(lambda run: thrown_block(0, within=lambda flight: np.mod(flight, 1))),
                        "boundary: along x, y .*not periodic.*--boundary periodic,periodic", None),
    "periods that are walls": (lambda data: data.state(boundary=("periodic", "wall"), domain=((0, 1), (-0.1, 1.1))),
                               "boundary: along x .* periodic.*--boundary wall,wall", None),
    "shared runs": (lambda data: data.runs["valid"].__setitem__(0, data.runs["train"][1]),
                    "shared trajectories: .*1 of 1.*train 00001 and valid 00000", 1),
    "same splits": (lambda data: data.runs.update(test=data.runs["train"][:1]), "test: .*test says nothing", 1),
    "shared starts": (lambda data: data.runs["valid"].__setitem__(0, drifted(data.runs["train"][1])),
                      "shared starts: .*train 00001 and valid 00000", 1),
    "walls as material": (lambda data: data.state(static_types=frozenset(), particle_types={3: "sand", 7: "goop"}),
                          "still particles: 100 of 100 particles of type 3, sand,.*--static 3", 1),
    "one type for both": (lambda data: data.change(stuck), "still particles: 30 of 500", None),
    "walls that move": (lambda data: data.change(wall_moves, ONE), "moving walls: .*train 00002, particle 119", None),
    "named a wall": (lambda data: data.state(particle_types={3: "boundary", 7: "moving wall"}), "walls that are", None),
    "mixed time steps": (lambda data: data.change(lambda run: thrown_block(2, 2 * FRAMES)[::2], ONE),
                         "mixed time steps: .*train 00002 it is 2 times", 2),
    "repeated frame": (lambda data: data.change(repeated, ONE), "repeated frames: .*train 00002, frame 9", None),
    "missing frame": (lambda data: data.change(lambda run: np.delete(run, 8, axis=0), ONE),
                      "missing frames: .*train 00002, frame 8: .*2.0 times", 2),
    "order": (lambda data: data.change(shuffled, ONE), "particle order: .*train 00002", None),
    "order once": (lambda data: data.change(shuffled_once, ONE), "particle order: .*train 00002, frame 20", None),
    "resolution": (lambda data: data.change(lambda run: thrown_block(9, spacing=0.03), ONE),
                   "different resolution: .*train 00002.* 1.5 times", 1.5),
    "far from the origin": (lambda data: data.move(1000.0), "float32: .*Subtract about .1000.0, 1000.0", None),
    "short": (lambda data: data.change(lambda run: run[:12], slice(0, 2)), "short trajectories: 2 of 5", 0.4),
    "noise": (lambda data: data.change_all(noisy), "measurement noise: .* errors of about 0.01.*--smooth 13", None),
    "overlap": (lambda data: data.change(doubled, ONE), "overlapping particles: .*train 00002", None),
    "teleport": (lambda data: data.change(teleported, ONE), "jumps: .*train 00002, frame 12, particle 5", None),
    "glitch": (lambda data: data.change(glitched, ONE), "jumps: .*train 00002, frame 12, particle 5", None),
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_a_lie_is_the_first_finding(lie, data, tmp_path):
    tell, words, factor = LIES[lie]
    tell(data)
    first, *others = data.findings(tmp_path)
    assert re.search(words, str(first)), (first, others)
    if factor is not None:
        assert first.factor == pytest.approx(factor, rel=0.08)


@pytest.mark.parametrize("cause", CAUSES)
def test_the_printed_command_mends_the_only_finding(cause, data, tmp_path):
    tell, words = CAUSES[cause]
    tell(data)
    (finding,) = [each for each in data.findings(tmp_path / "data") if each.severity != Severity.NOTE]
    assert re.search(words, str(finding)), finding
    (options,) = re.findall(r"nmpm convert FOLDER NEW ([^;]*?)\.(?: |$)", finding.sentence)
    main(["convert", str(tmp_path / "data"), str(tmp_path / "new"), *options.split()])
    again = inspect(FolderSource(tmp_path / "new")).findings
    assert [str(each) for each in again if each.severity != Severity.NOTE] == []


@pytest.mark.parametrize("unit", [1.0, 1e-3, 60.0], ids=["s", "ms", "min"])
def test_times_and_velocities_of_other_units_are_a_note(unit, data, tmp_path):
    record(data, TIME / unit, EVERY, velocity_unit=1)
    data.state(dt=DT / unit, gravity=(0.0, -GRAVITY * unit**2))
    findings = data.findings(tmp_path)
    assert [finding.severity for finding in findings] == ([] if unit == 1 else [Severity.NOTE])
    assert all(f"frames are {DT / unit:.4g} apart by recorded times" in finding.sentence for finding in findings)


@pytest.mark.parametrize(
    ("reset", "out", "told"), [(False, False, "periodic"), (True, False, ""), (False, True, "open")]
)
def test_a_boundary_is_periodic_only_where_particles_go_on_as_they_came(data, tmp_path, reset, out, told):
    data.runs = {name: [stream(seed, reset, out) for seed, _ in enumerate(runs)] for name, runs in data.runs.items()}
    data.state(gravity=None, particle_volume=None)
    found = [str(finding) for finding in data.findings(tmp_path) if finding.kind == "boundary"]
    assert [re.findall(r"--boundary (\w+),wall", each) for each in found] == ([[told]] if told else [])


@pytest.mark.parametrize("coarse", [1.0, 2.0])
def test_grains_in_flight_are_of_no_other_resolution(data, tmp_path, coarse):
    kinds_of_rain = [(SPACING, 20), (SPACING, 90), (SPACING * coarse, 24)]
    data.runs = {"train": [rain(seed, *kind) for seed, kind in enumerate(kinds_of_rain)]}
    data.state(gravity=None, particle_volume=None)
    kinds = {finding.kind for finding in data.findings(tmp_path)}
    assert ("different resolution" in kinds) == (coarse > 1)


def test_other_units_change_no_finding(data, tmp_path):
    data.change(teleported, ONE)
    data.state(gravity=(0.0, 4 * GRAVITY))
    length, time = 1000.0, 1e-3
    findings = data.findings(tmp_path)
    data.change_all(lambda run: length * run)
    data.state(
        dt=time * DT,
        gravity=(0.0, 4 * GRAVITY * length / time**2),
        particle_volume=(length * SPACING) ** 2,
        bounds=((0.0, length),) * 2,
        domain=((-0.1 * length, 1.1 * length),) * 2,
    )
    others = data.findings(tmp_path / "others")
    assert [(one.kind, one.where, one.details) for one in findings] == [
        (other.kind, other.where, other.details) for other in others
    ]
    assert findings[0].factor == pytest.approx(others[0].factor)


def test_a_training_warns_of_contradictions_in_few_lines(data, tmp_path):
    data.findings(tmp_path)
    assert contradictions_warning(FolderSource(tmp_path)) == ""
    data.state(gravity=(0.0, GRAVITY), dt=2 * DT, particle_volume=1.0, boundary=("periodic", "wall"))
    data.state(domain=((0.0, 1.0), (-0.1, 1.1)), static_types=frozenset())
    data.findings(tmp_path)
    _, *findings, command = contradictions_warning(FolderSource(tmp_path)).splitlines()
    assert len(findings) == 3
    assert command == f"  All of it (and 2 more): nmpm inspect {tmp_path}"


def test_particles_that_come_and_go_are_noted(data, tmp_path):
    data.change(absent, ONE)
    (note,) = data.findings(tmp_path)
    assert note.severity == Severity.NOTE
    assert "1 of 100 particles come" in note.sentence


def test_a_trajectory_in_a_larger_box_is_named():
    box, stays = np.array([[0.0, 1.0], [0.0, 0.7]]), np.ones((2, 2))
    extents = {f"train {index}": box + 0.001 * index for index in range(4)}
    assert not list(compare_domains(extents, dict.fromkeys(extents, stays), SPACING))
    extents["train 4"] = box * 1.5
    (finding,) = compare_domains(extents, dict.fromkeys(extents, stays), SPACING)
    assert "in 1 of 5 trajectories particles stay at x = 1.5, e.g. in train 4" in finding.sentence
