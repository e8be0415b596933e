"""A session: applies what a player does to a scene, and answers with messages for the page.

It knows nothing of networks. The server passes on what comes in by `receive`, and sends what `tick` gives 60 times a
second. A message of the page is a JSON object: `do` is the name of one of `COMMANDS`, methods of a session, and the
other keys are its arguments. They are in domain length, seconds and radians; (D,) where they are points or vectors.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import make_dataclass
from functools import cache
from inspect import signature
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, TypeVar, get_type_hints

import torch

from nmpm._support.messages import one_line, suggestion
from nmpm._support.plain_data import from_plain
from nmpm.data.predictions import read_description
from nmpm.data.write import write_trajectory
from nmpm.errors import ConfigError, NmpmError
from nmpm.obstacles import Disc, Ramp
from nmpm.play import pictures
from nmpm.play.beside import SimulatorBeside
from nmpm.play.limits import SceneLimits
from nmpm.play.placing import ANGLE, Jet, Movable, Pour, block, moved, new_body, push, with_room
from nmpm.play.recording import PlayedFrames, free_name
from nmpm.play.world import World, first_frame, simulator_of
from nmpm.zoo.states import StateBuilder

if TYPE_CHECKING:
    from nmpm.zoo import Pretrained

T = TypeVar("T")
Message = str | bytes
Vector = tuple[float, ...]

MOST_BYTES = 1000
"""Longest message of a page."""
MOST_BODIES = 12
AHEAD = 4
"""Pictures that may be on their way: a page that draws fewer than 60 a second, or is hidden, slows the session."""
_STATUS_TICKS = 15


class Session:
    """A scene that somebody plays with.

    Args:
        model: What predicts.
        seed: Of the first scene.
        out: File to write what was played to; a number is added where there is one already.
    """

    def __init__(self, model: Pretrained, seed: int, out: Path) -> None:
        self.model, self.scene, self.out = model, model.scene, out
        self.limits = SceneLimits(model)
        self.playing, self.pace = True, 1
        self._preset, self._thread = simulator_of(model), ThreadPoolExecutor(1)
        self._beside: SimulatorBeside | None = None
        self._outbox: list[Message] = []
        self._ticks = self._picture = self._seen = 0
        self.restart(seed)

    def receive(self, text: Message) -> None:
        """Do what a message says; whatever is wrong with it is answered by a message, and changes nothing."""
        try:
            name, values = _read_command(text)
            COMMANDS[name](self, **values)
        except NmpmError as error:
            self.say(one_line(error, 300))

    def say(self, text: str, kind: str = "problem") -> None:
        """Show a line on the page."""
        self._outbox.append(json.dumps({"say": text, "kind": kind}))

    def greet(self) -> list[Message]:
        """What a page needs that has just been opened; what another one has not seen is forgotten."""
        self._seen, self._outbox = self._picture, []
        described = pictures.describe_played(
            self.model,
            self.limits,
            self.world.static,
            title=f"nmpm play · {self.model.name}",
            seed=self.seed,
            obstaclesMove=self.scene.obstacles and self.scene.dim == 2,
            gravityTurns=self.scene.gravity_varies,
            simulator=None if self._preset is None else self._preset.generator,
            tools=("throw", "pour", "look")[: self.scene.dim],
            playing=self.playing,
            pace=self.pace,
            beside=self._beside is not None,
        )
        self._show_all()
        return [json.dumps({"scene": described}), *self._sent()]

    def tick(self) -> list[Message]:
        """Go on by a picture if it is time for one; the messages to send."""
        self._ticks += 1
        if self._picture - self._seen < AHEAD:
            if self.playing:
                for _ in range(self.pace):
                    self._advance()
                self._changed = True
            if self._changed:
                self._show()
            self._show_simulated()
        if self._ticks % _STATUS_TICKS == 0:
            self._outbox.append(self._status())
        return self._sent()

    def close(self) -> None:
        """End the thread that predicts, and the simulator beside, if there is one."""
        self.set_beside(False)
        self._thread.shutdown()

    # What a player can do, see `COMMANDS`; raises an NmpmError, and changes nothing, where it cannot be done.

    def throw(self, material: int, at: Vector, sides: Vector, velocity: Vector) -> None:
        """Put a block of a material around a point, with a velocity."""
        self.limits.check_throw(material, at, sides, velocity)
        if not self._add(block(at, sides, self.scene.particle_spacing), velocity, material):
            raise ConfigError("there is no room for a block here")

    def pour(self, material: int, at: Vector, velocity: Vector, width: float) -> None:
        """Pour a material at a point until it is stopped; again, to move the point."""
        pour = Pour(material, at, velocity, width)
        self.limits.check_pour(pour)
        self._jet.turn(pour)

    def stop(self) -> None:
        """Stop pouring."""
        self._jet.turn(None)

    def move(self, body: int, centre: Vector, angle: float) -> None:
        """Move a body, which pushes particles out of its way."""
        before = self._body(body)
        self.limits.check_vector("centre", centre)
        after = moved(before, centre, math.remainder(angle, 2 * math.pi))
        self.world.set_bodies({**self.world.bodies, body: after})
        state = self.world.now()
        margin, limit = 0.5 * self.scene.particle_spacing, self.limits.fastest.amin(dim=0) * self.scene.dt
        position, velocity = push(after, state.position[0], state.velocity[0], margin, limit)
        low, high = position.new_tensor(self.scene.bounds).T
        self.world.set_motion(position.clamp(low, high)[None], velocity[None])
        self._bodies_changed()

    def put(self, kind: Literal["ramp", "disc"], centre: Vector) -> None:
        """Put another body into the scene."""
        self.limits.check_vector("centre", centre)
        if self.scene.dim != 2:
            raise ConfigError("bodies can be put into scenes in two dimensions alone")
        if len(self.world.bodies) >= MOST_BODIES:
            raise ConfigError(f"there are {MOST_BODIES} bodies already: take one away first")
        number = 1 + max(self.world.bodies, default=-1)
        self.world.set_bodies({**self.world.bodies, number: new_body(kind, centre, self.model.emulator)})
        self.move(number, centre, ANGLE)

    def remove(self, body: int) -> None:
        """Take a body away."""
        self._body(body)
        self.world.set_bodies({key: other for key, other in self.world.bodies.items() if key != body})
        self._bodies_changed()

    def set_gravity(self, vector: Vector) -> None:
        """Turn gravity, in length per second squared."""
        self.limits.check_vector("gravity", vector)
        builder = StateBuilder(self.model.emulator, self.world.now().position, torch.float32)
        self.world.set_gravity(builder.gravity(vector))
        self._scene_changed()

    def set_playing(self, on: bool) -> None:
        """Play, or pause."""
        self.playing = on

    def step(self) -> None:
        """Go on by one frame, and pause."""
        self.playing = False
        self._advance()
        self._changed = True

    def set_pace(self, frames: Literal[1, 2, 4]) -> None:
        """So many frames of the model for each picture."""
        self.pace = frames

    def restart(self, seed: int) -> None:
        """Start from the scene of a seed."""
        self.limits.check_seed(seed)
        self.world = World(self.model.emulator, *first_frame(self.model, seed), self._thread)
        self.seed, self.frame, self.recording = seed, 0, PlayedFrames()
        self._jet = Jet(self.scene.particle_spacing, self.scene.dt)
        self._show_all()
        self._scene_changed()

    def set_beside(self, on: bool) -> None:
        """Run the simulator beside the emulator from its present state, or end that."""
        if self._beside is not None:
            self._beside.close()
        self._beside = None
        if on:
            if self._preset is None:
                raise ConfigError("no simulator is known for this model's scenes")
            beside = SimulatorBeside(self.scene, self._preset)
            beside.start(self.world, self.frame)
            self._beside = beside

    def save(self) -> None:
        """Write what was played since the last restart."""
        model, world = f"the model {self.model.name}, played with", self.world
        made = self.recording.trajectory(self.scene, world.material, world.now().gravity, world.static, model)
        path = free_name(self.out)
        write_trajectory(path, made, read_description(made.attributes, path, len(made.position))[1])
        lost = f", without the first {self.recording.forgotten}" if self.recording.forgotten else ""
        self.say(f"wrote {len(made.position)} frames{lost} to {path}: nmpm view {path}", "news")

    def see(self, picture: int) -> None:
        """The page has drawn a picture, by its number."""
        if not self._seen <= picture <= self._picture:
            raise ConfigError(f"picture = {one_line(picture, 30)} was not sent")
        self._seen = picture

    def _body(self, number: int) -> Movable:
        body = self.world.bodies.get(number)
        if not isinstance(body, Ramp | Disc):
            raise ConfigError(f"there is no body {one_line(number, 30)}")
        return body

    # The rest.

    def _advance(self) -> None:
        """The next frame, with what is poured until there."""
        if self._jet.pour is not None:
            self._add_poured(self._jet.pour)
        self.world.advance()
        self.frame += 1
        self.recording.add(self.world.position, self.world.bodies)

    def _add_poured(self, pour: Pour) -> None:
        rows = self._jet.rows(pour)
        try:
            if rows is not None:
                self._add(rows, pour.velocity, pour.material)
        except ConfigError as error:
            self._jet.turn(None)
            self.say(str(error))

    def _add(self, points: torch.Tensor, velocity: Sequence[float], material: int) -> int:
        """Add those of points (N, D) for which there is room; how many these are."""
        world = self.world
        others = [position.double() for position in (world.position, world.static[0])]
        free = with_room(points, self.scene, others, world.bodies.values())
        if world.count + len(free) > self.limits.most_particles:
            raise ConfigError(f"there are at most {self.limits.most_particles} particles: restart to begin anew")
        if len(free):
            world.add(free, torch.tensor(velocity, dtype=torch.float64) * self.scene.dt, material)
            self._particles_changed()
        return len(free)

    def _particles_changed(self) -> None:
        self._outbox.append(pictures.materials(self.world.material.numpy()))
        self._scene_changed()

    def _bodies_changed(self) -> None:
        self._outbox.append(pictures.describe_bodies(self.world.bodies))
        self._scene_changed()

    def _scene_changed(self) -> None:
        """Show the scene in the next picture, and let the simulator beside start from it."""
        self._changed = True
        self._ask_beside(lambda beside: beside.start(self.world, self.frame))

    def _ask_beside(self, call: Callable[[SimulatorBeside], T]) -> T | None:
        """What the simulator beside answers; None without one, and where it fails, which the page is told."""
        try:
            return None if self._beside is None else call(self._beside)
        except NmpmError as error:
            self.set_beside(False)
            self.say(one_line(error, 300))
            return None

    def _show_all(self) -> None:
        self._outbox.append(json.dumps({"seed": self.seed, "gravity": self.world.gravity}))
        self._particles_changed()
        self._bodies_changed()
        self._show()

    def _show(self) -> None:
        self._changed = False
        self._picture += 1
        position = self.world.position.numpy()
        self._outbox.append(pictures.picture(self.scene, pictures.EMULATOR, self._picture, self.frame, position))

    def _show_simulated(self) -> None:
        """The picture of the simulator beside, as far as it has come."""
        frames = self.pace if self.playing else 0
        shown = self._ask_beside(lambda beside: beside.advance(self.world, self.frame, frames))
        if shown is not None:
            self._outbox.append(pictures.picture(self.scene, pictures.SIMULATOR, self._picture, *shown))

    def _status(self) -> str:
        status = {
            "particles": self.world.count,
            "call": 1000 * self.world.call_seconds,
            "simulator": 1000 * self._beside.frame_seconds if self._beside is not None else None,
            "playing": self.playing,
            "beside": self._beside is not None,
        }
        return json.dumps({"status": status})

    def _sent(self) -> list[Message]:
        sent, self._outbox = self._outbox, []
        return sent


COMMANDS: Mapping[str, Callable[..., None]] = MappingProxyType(
    {
        "throw": Session.throw,
        "pour": Session.pour,
        "stop": Session.stop,
        "move": Session.move,
        "put": Session.put,
        "remove": Session.remove,
        "gravity": Session.set_gravity,
        "play": Session.set_playing,
        "step": Session.step,
        "pace": Session.set_pace,
        "restart": Session.restart,
        "beside": Session.set_beside,
        "save": Session.save,
        "seen": Session.see,
    }
)
"""What a player can do, by the value of `do`."""


def _read_command(message: Message) -> tuple[str, dict[str, Any]]:
    """The name and the arguments of a message's command; ConfigError if there is none, or they are not its own."""
    if len(message) > MOST_BYTES:
        raise ConfigError(f"the message has {len(message)} characters; at most {MOST_BYTES} are read")
    try:
        plain = json.loads(message)
    except (ValueError, RecursionError) as error:
        raise ConfigError(f"the message is no JSON: {one_line(error, 80)}") from error
    if not isinstance(plain, dict) or not isinstance(plain.get("do"), str):
        raise ConfigError('the message has no "do"')
    name = plain.pop("do")
    if name not in COMMANDS:
        raise ConfigError(f"there is no {one_line(repr(name), 40)}.{suggestion(name[:40], COMMANDS)}")
    return name, dict(vars(from_plain(_arguments(COMMANDS[name]), plain, name)))


@cache
def _arguments(command: Callable[..., None]) -> type:
    """The arguments of a command as a dataclass, by which values are checked."""
    hints = get_type_hints(command)
    return make_dataclass("Arguments", [(name, hints[name]) for name in list(signature(command).parameters)[1:]])
