"""Small models to play with."""

import json

import numpy as np
import pytest
import torch

from nmpm.play import pictures
from nmpm.play.session import Session
from nmpm.sim import load_preset
from nmpm.zoo import Pretrained
from tests.scenes import emulator_of


def model_of(preset: str) -> Pretrained:
    """A model of made-up weights for a preset's scenes, whose particles mostly fall."""
    emulator = emulator_of(load_preset(preset).scene, cells=16, scale=0.01, energy=True).requires_grad_(False)
    for limit, values in ((0.5, emulator.input_high), (-0.5, emulator.input_low)):
        values.fill_(limit)
    return Pretrained(emulator, {"name": preset, "dataset": f"{preset}, simulated by nmpm"})


class Player:
    """A page without a browser: sends commands, and keeps what comes back."""

    def __init__(self, session: Session) -> None:
        self.session, self.texts, self.sent = session, {}, []
        self.take(session.greet())

    def take(self, messages):
        for message in messages:
            if isinstance(message, str):
                self.texts.update(json.loads(message))
            else:
                kind, number, frame, count = np.frombuffer(message, "<u4", 4)
                self.sent.append((int(kind), int(frame), message[16:], int(count)))
                if kind == pictures.EMULATOR:
                    self.session.receive(json.dumps({"do": "seen", "picture": int(number)}))

    def do(self, name, **values):
        """Send a command; what is said to it, if anything."""
        self.texts.pop("say", None)
        self.session.receive(json.dumps({"do": name, **values}))
        self.tick()
        return self.texts.get("say")

    def tick(self, count=1):
        for _ in range(count):
            self.take(self.session.tick())

    def positions(self, kind):
        """(N, D) of the pictures of a kind by frame, in domain length; NaN where a particle is not there."""
        scene = self.texts["scene"]
        low, high = np.array(scene["low"]), np.array(scene["high"])
        shown = {m[1]: np.frombuffer(m[2], "<u2").reshape(-1, scene["dim"]) for m in self.sent if m[0] == kind}
        return {at: np.where(steps == 65535, np.nan, low + (high - low) * steps / 65535) for at, steps in shown.items()}

    @property
    def position(self):
        """(N, D) of the last picture of the emulator."""
        return list(self.positions(pictures.EMULATOR).values())[-1]


@pytest.fixture
def play(tmp_path):
    """Opens a session with a model, by its preset's name."""
    torch.set_num_threads(1)
    sessions = []

    def opened(preset="waterramps", seed=1, **changes):
        sessions.append(Session(model_of(preset), seed, tmp_path / "played.h5"))
        return Player(sessions[-1])

    yield opened
    for session in sessions:
        session.close()
