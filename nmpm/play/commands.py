"""What a player can do. Fields are in domain length, seconds and radians; (D,) where they are points or vectors."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from nmpm.play.session import Session

Vector = tuple[float, ...]


class Command(abc.ABC):
    """Something that a player does."""

    @abc.abstractmethod
    def apply(self, session: Session) -> None:
        """Do it; raises an `NmpmError`, and changes nothing, where it cannot be done."""


@dataclass(frozen=True)
class Throw(Command):
    """Put a block of a material around a point, with a velocity."""

    material: int
    at: Vector
    sides: Vector
    velocity: Vector

    def apply(self, session: Session) -> None:
        session.throw(self)


@dataclass(frozen=True)
class Pour(Command):
    """Pour a material at a point until it is stopped; again, to move the point."""

    material: int
    at: Vector
    velocity: Vector
    width: float

    def apply(self, session: Session) -> None:
        session.pour(self)


@dataclass(frozen=True)
class StopPouring(Command):
    """Stop pouring."""

    def apply(self, session: Session) -> None:
        session.pour(None)


@dataclass(frozen=True)
class Move(Command):
    """Move a body."""

    body: int
    centre: Vector
    angle: float

    def apply(self, session: Session) -> None:
        session.move(self.body, self.centre, self.angle)


@dataclass(frozen=True)
class Put(Command):
    """Put another body into the scene."""

    kind: Literal["ramp", "disc"]
    centre: Vector

    def apply(self, session: Session) -> None:
        session.put(self.kind, self.centre)


@dataclass(frozen=True)
class Remove(Command):
    """Take a body away."""

    body: int

    def apply(self, session: Session) -> None:
        session.remove(self.body)


@dataclass(frozen=True)
class Gravity(Command):
    """Turn gravity, in length per second squared."""

    vector: Vector

    def apply(self, session: Session) -> None:
        session.set_gravity(self.vector)


@dataclass(frozen=True)
class Play(Command):
    """Play, or pause."""

    on: bool

    def apply(self, session: Session) -> None:
        session.playing = self.on


@dataclass(frozen=True)
class Step(Command):
    """Go on by one frame, and pause."""

    def apply(self, session: Session) -> None:
        session.step()


@dataclass(frozen=True)
class Pace(Command):
    """So many frames of the model for each picture."""

    frames: Literal[1, 2, 4]

    def apply(self, session: Session) -> None:
        session.pace = self.frames


@dataclass(frozen=True)
class Restart(Command):
    """Start from the scene of a seed."""

    seed: int

    def apply(self, session: Session) -> None:
        session.restart(self.seed)


@dataclass(frozen=True)
class Beside(Command):
    """Run the simulator beside the emulator from its present state, or end that."""

    on: bool

    def apply(self, session: Session) -> None:
        session.set_beside(self.on)


@dataclass(frozen=True)
class Save(Command):
    """Write what was played since the last restart."""

    def apply(self, session: Session) -> None:
        session.save()


@dataclass(frozen=True)
class Seen(Command):
    """The page has drawn a picture, by its number."""

    picture: int

    def apply(self, session: Session) -> None:
        session.see(self.picture)
