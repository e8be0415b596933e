"""What a player does, and what the page is sent for it."""

import json
import random

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from nmpm.data.convert import native_file
from nmpm.data.format import Split
from nmpm.play import pictures
from nmpm.play import session as sessions
from nmpm.viz.viewer import page_of_files
from tests.data import fuzzing


def room(player):
    """The point in the upper half of the box that is farthest from particles, bodies and walls."""
    points = np.stack(np.meshgrid(np.linspace(0.16, 0.84, 30), np.linspace(0.5, 0.84, 15)), axis=-1).reshape(-1, 2)
    apart = [np.linalg.norm(points[:, None] - player.position, axis=-1).min(1)]
    apart += [body.distance(torch.from_numpy(points)).numpy() for body in player.session.world.bodies.values()]
    return points[np.min(apart, axis=0).argmax()].tolist()


def throw(player, **changes):
    values = {"material": 0, "at": room(player), "sides": [0.06, 0.06], "velocity": [0.0, 0.0]}
    return player.do("throw", **(values | changes))


def test_a_thrown_block_appears_in_the_next_picture_and_flies(play):
    player = play()
    before, at = len(player.position), room(player)
    velocity = np.where(np.array(at) < 0.5, 1.0, -1.0)  # into the box
    assert throw(player, velocity=velocity.tolist()) is None
    thrown = player.position[before:]
    assert len(thrown) == 36  # 0.06 / 0.0107 are six particles
    dt = player.session.scene.dt
    expected = np.array(at) + dt * velocity
    assert thrown.mean(0) == pytest.approx(expected, abs=2e-3)
    player.tick(10)
    time = 11 * dt
    expected = np.array(at) + time * velocity + [0.0, -9.81 * time**2 / 2]
    assert player.position[before:].mean(0) == pytest.approx(expected, abs=0.02)


def test_blocks_take_no_room_of_others_and_no_more_than_there_is(play, monkeypatch):
    player = play("goop")
    inside = player.position[0].tolist()
    assert throw(player, at=inside, sides=[0.01, 0.01]) == "there is no room for a block here"
    assert "at most" in throw(player, sides=[0.8, 0.9])
    assert "beyond" in throw(player, velocity=[100.0, 0.0])
    assert "2 axes" in throw(player, at=[0.5, 0.5, 0.5])
    assert "there are 1, goop" in throw(player, material=1)
    player.session.limits.most_particles = player.session.world.count + 10
    assert "at most" in throw(player)
    assert len(player.position) == player.session.world.count


def test_pouring_goes_on_until_it_is_stopped(play):
    player = play("goop")
    before = player.session.world.count
    assert player.do("pour", material=0, at=[0.2, 0.85], velocity=[0.0, -1.0], width=0.03) is None
    player.tick(30)
    poured = player.session.world.count - before
    assert poured > 20
    player.do("stop")
    now = player.session.world.count
    player.tick(10)
    assert player.session.world.count == now
    assert player.do("pour", material=0, at=[0.2, 0.85], velocity=[0.0, 0.0], width=0.03) == (
        "what is poured needs a velocity"
    )


def test_a_dragged_ramp_pushes_particles_out_of_its_way(play):
    player = play()
    ramp = player.texts["bodies"][0]
    target = player.position.mean(0).tolist()
    assert player.do("move", body=ramp["id"], centre=target, angle=0.5) is None
    body = player.session.world.bodies[ramp["id"]]
    player.tick(2)
    inside = body.distance(player.session.world.position.double())
    assert (inside > -0.5 * player.session.scene.particle_spacing).all()
    assert player.texts["bodies"][0]["centre"] == pytest.approx(target)
    assert "there is no body 77" in player.do("move", body=77, centre=target, angle=0.0)
    assert "no part of it is within the domain" in player.do("move", body=ramp["id"], centre=[9.0, 9.0], angle=0.0)
    assert player.texts["bodies"][0]["centre"] == pytest.approx(target)


def test_bodies_are_put_and_taken_away_where_the_model_has_obstacles(play):
    player = play()
    count = len(player.texts["bodies"])
    assert player.do("put", kind="disc", centre=[0.3, 0.8]) is None
    assert player.texts["bodies"][-1]["kind"] == "disc"
    assert player.do("remove", body=player.texts["bodies"][-1]["id"]) is None
    assert len(player.texts["bodies"]) == count
    for _ in range(sessions.MOST_BODIES - count):
        player.do("put", kind="ramp", centre=[0.5, 0.8])
    assert "already" in player.do("put", kind="ramp", centre=[0.5, 0.8])
    assert "without obstacles" in play("goop").do("put", kind="disc", centre=[0.3, 0.8])


def test_gravity_turns_where_it_is_an_input(play):
    player = play("variablegravity")
    pull = np.hypot(*player.texts["gravity"])
    assert player.do("gravity", vector=[pull, 0.0]) is None
    start = player.position.mean(0)
    player.tick(20)
    assert player.position.mean(0)[0] > start[0] + 0.005
    assert "outside of the range" in player.do("gravity", vector=[1e4, 0.0])
    assert "knows only" in play("goop").do("gravity", vector=[9.81, 0.0])


def test_pause_and_step(play):
    player = play("goop")
    player.do("play", on=False)
    frame = player.session.frame
    pictures = len(player.sent)
    player.tick(5)
    assert (player.session.frame, len(player.sent)) == (frame, pictures)
    player.do("step")
    assert player.session.frame == frame + 1
    player.do("pace", frames=4)
    player.do("play", on=True)
    assert player.session.frame == frame + 5


def test_a_restart_gives_the_same_again(play):
    player = play()
    at = room(player)

    def played():
        player.do("play", on=False)
        player.do("restart", seed=1)
        throw(player, at=at)
        for _ in range(20):
            player.do("step")
        return player.position

    once, count = played(), player.session.world.count
    assert np.array_equal(played(), once)
    assert player.session.frame == 20
    player.do("restart", seed=2)
    assert player.session.world.count != count
    assert "must be" in player.do("restart", seed=-1)


def test_what_is_predicted_ahead_is_what_a_rollout_predicts_and_dropped_when_the_scene_changes(play):
    player = play()
    model = player.session.model
    state = player.session.world.now()
    player.tick(20)
    rolled = model.rollout(state, 20)[0, -1]
    assert torch.equal(player.session.world.position, rolled[: player.session.world.count])
    player.tick(2)  # the next bundle is being predicted
    count, now = player.session.world.count, player.session.world.position.clone()
    before = player.session.world._path[player.session.world._index - 1, :count]
    throw(player)
    after = player.session.world.position[:count]
    assert len(player.position) == count + 36
    assert (after - now).norm(dim=-1).max() < 2 * (now - before).norm(dim=-1).max() + 0.01


def test_what_was_played_is_a_trajectory_that_the_viewer_opens(play):
    player = play()
    assert "nothing was played yet" in play().do("save")
    count = player.session.world.count
    player.tick(4)
    throw(player)
    player.do("put", kind="disc", centre=[0.3, 0.8])
    player.do("move", body=player.texts["bodies"][0]["id"], centre=[0.5, 0.5], angle=0.3)
    player.tick(4)
    assert "nmpm view" in player.do("save")
    path = player.session.out
    played = Split(native_file(path)).read(0)
    moving = played.particle_type == 5
    assert moving.sum() == count + 36
    absent = np.isnan(played.position[:, moving, 0]).sum(1)
    assert absent[0] == 36
    assert absent[-1] == 0
    assert len(page_of_files((path, 0), None).html) > 5e4
    player.do("save")
    assert path.with_stem("played-2").exists()


def test_a_slow_page_slows_the_session_down(play):
    player = play("goop")
    frame = player.session.frame
    for _ in range(50):
        player.session.tick()
    assert player.session.frame <= frame + sessions.AHEAD


def test_the_simulator_begins_beside_the_emulator_once_it_is_ready(play):
    player = play("goop")
    player.tick(3)
    assert player.do("beside", on=True) is None
    for _ in range(600):
        player.tick()
        player.session._beside._process.join(0.1)  # (waits a little)
        simulated = player.positions(pictures.SIMULATOR)
        if len(simulated) > 3:
            break
    emulated = player.positions(pictures.EMULATOR)
    first = min(simulated)
    assert first > 4  # not from where it was asked for
    assert np.abs(simulated[first] - emulated[first - 1]).max() < 0.03
    ramps = play()
    assert ramps.do("put", kind="disc", centre=[0.3, 0.8]) is None
    no_discs = "the simulator has no discs: take them away, then start it again (B)"
    assert ramps.do("beside", on=True) == no_discs
    assert ramps.session._beside is None
    assert ramps.do("remove", body=max(ramps.session.world.bodies)) is None
    assert ramps.do("beside", on=True) is None
    assert ramps.do("put", kind="disc", centre=[0.3, 0.8]) == no_discs  # said, and the simulator ends
    assert ramps.session._beside is None


MESSAGES = (
    {"do": "throw", "material": 0, "at": [0.5, 0.8], "sides": [0.05, 0.05], "velocity": [0.1, 0.0]},
    {"do": "pour", "material": 0, "at": [0.5, 0.8], "velocity": [0.0, -0.5], "width": 0.05},
    {"do": "stop"},
    {"do": "move", "body": 0, "centre": [0.5, 0.5], "angle": 0.3},
    {"do": "put", "kind": "disc", "centre": [0.5, 0.5]},
    {"do": "remove", "body": 1},
    {"do": "gravity", "vector": [0.0, -9.81]},
    {"do": "play", "on": False},
    {"do": "step"},
    {"do": "pace", "frames": 2},
    {"do": "restart", "seed": 1},
    {"do": "beside", "on": True},
    {"do": "seen", "picture": 0},
)  # fmt: skip
NUMBERS = (
    st.sampled_from([0, 1, 1.0, True, False, -1, 2, 4.0, 1e-300, 1e999, -1e999, float("nan"), 2**31, 10**30])
    | st.integers() | st.floats() | st.floats(0, 1)
)  # fmt: skip


@st.composite
def mutated_messages(draw) -> str | bytes:
    """A message with some of its values or its text changed, or one that is none."""
    message = draw(st.sampled_from(MESSAGES) | st.dictionaries(st.text(max_size=6), fuzzing.VALUES, max_size=4))
    for _ in range(draw(st.integers(0, 2))):
        if found := list(fuzzing.places(message)):
            value = draw(NUMBERS | st.lists(NUMBERS, max_size=4) | fuzzing.VALUES)
            message = fuzzing.changed(message, draw(st.sampled_from(found)), value)
    text = json.dumps(message)
    if draw(st.booleans()) and draw(st.booleans()):
        return fuzzing.damage(text.encode(), fuzzing.random_changes(random.Random(draw(st.integers(0, 10**6)))))
    return text


def receive_mutated(player, count):
    player.session.limits.most_particles = player.session.world.count + 300
    for text in ["[" * 999, "", "null", "{}", '{"do": ["throw"]}', "x" * 10_000, b"\xff" * 900]:
        player.session.receive(text)

    @settings(fuzzing.FUZZ, max_examples=count)
    @given(mutated_messages())
    def receive(message):
        player.session.receive(message)
        player.tick()

    receive()
    assert player.do("pace", frames=1) is None
    player.do("stop")
    player.do("play", on=True)
    frame = player.session.frame
    player.tick(3)
    assert player.session.frame > frame
    assert np.isfinite(player.position).all()


def test_no_message_ends_a_session(play):
    receive_mutated(play(), 100)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["waterramps", "goop"])
def test_thousands_of_messages_end_no_session(play, preset):
    receive_mutated(play(preset), 3000)


@pytest.mark.parametrize("frames", [1.0, True, 4.0, "1", [1]])
def test_a_pace_is_a_whole_number(play, frames):
    player = play()
    assert "should be one of 1, 2, 4" in player.do("pace", frames=frames)
    player.tick(3)
    assert player.do("pace", frames=2) is None
