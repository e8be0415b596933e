"""Checks of the states and models that rollouts start from."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from nmpm.emulator.constraints import distance_beyond
from nmpm.emulator.model import Emulator
from nmpm.errors import DataError
from nmpm.particles import Particles
from nmpm.scene import Scene

ROUNDING = 1e-3
"""Cells by which particles may start outside of the bounds without a warning."""


class _Numbers(NamedTuple):
    """Numbers (B, K, V) of a state that must be finite where they are real (B, K), and what an error calls them."""

    name: str
    values: Tensor
    real: Tensor

    @property
    def wrong(self) -> Tensor:
        """(B, K) bool."""
        return ~self.values.isfinite().all(-1) & self.real


def _state_numbers(particles: Particles) -> list[_Numbers]:
    real = particles.mask
    vectors = {name: getattr(particles, name) for name in ("position", "velocity")}
    numbers = {name: values.unsqueeze(-1) for name, values in particles.fields.items()}
    return [
        *(
            _Numbers(f"particle {{}}: its {name}", values.expand(*real.shape, -1), real)
            for name, values in (vectors | numbers).items()
        ),
        _Numbers("obstacle particle {}: its position", particles.obstacle, particles.obstacle_mask),
        *_optional_numbers(particles),
        _Numbers("its gravity", particles.gravity.unsqueeze(1), torch.ones_like(real[:, :1])),
    ]


def _optional_numbers(particles: Particles) -> Iterator[_Numbers]:
    if particles.volume is not None:
        yield _Numbers("particle {}: its volume", particles.volume.unsqueeze(-1), particles.mask)
    if particles.obstacle_velocity is not None:
        yield _Numbers("obstacle particle {}: its velocity", particles.obstacle_velocity, particles.obstacle_mask)


def check_inputs(emulator: Emulator, particles: Particles) -> None:
    """Raise DataError for emulators with non-finite weights, and states that are non-finite or outside of the domain.

    All checks are read back from the device at once; details are computed only if one fails.
    """
    real, materials = particles.mask, emulator.scene.materials
    numbers = _state_numbers(particles)
    wrong = [given.wrong for given in numbers]
    beyond = beyond_walls(emulator.scene, particles.position) & real
    unknown = ((particles.material < 0) | (particles.material >= len(materials))) & real
    weights = emulator.state_dict()
    unsound = [~values.isfinite().all() for values in weights.values()]
    checks = [torch.stack(unsound).any(), *(bad.any() for bad in (*wrong, unknown, beyond))]
    if not bool(torch.stack(checks).any()):
        return
    for name, bad in zip(weights, unsound, strict=True):
        if bad:
            raise DataError(f"The emulator's {name} holds values that are not finite: load a sound checkpoint.")
    for given, bad in zip(numbers, wrong, strict=True):
        if bad.any():
            scene, index = map(int, bad.nonzero()[0])
            raise DataError(
                f"Scene {scene} of the batch, {given.name.format(index)} is {given.values[scene, index].tolist()}; it"
                " must be finite."
            )
    if unknown.any():
        scene, particle = map(int, unknown.nonzero()[0])
        kind = int(particles.material[scene, particle])
        raise DataError(
            f"Scene {scene} of the batch, particle {particle}: its material is {kind}; it must be an index, from 0,"
            f" into the model's {len(materials)} ({', '.join(materials)})."
        )
    scene, particle = map(int, beyond.nonzero()[0])
    raise DataError(
        f"Scene {scene} of the batch, particle {particle}: it is at {particles.position[scene, particle].tolist()},"
        f" outside of the domain {list(emulator.scene.domain)} ({int(beyond.sum())} particles are)."
    )


def warn_of_training_mode(emulator: Emulator) -> None:
    """Warn of an emulator in training mode, such as a module's own, whose rollouts would be other than intended."""
    limits = emulator.constraints
    constrained = limits.energy or limits.rest_speed or limits.density_cap
    constrained = constrained or (limits.solids and emulator.scene.obstacles)
    if emulator.training and (constrained or emulator.recipe.grid_noise):
        warnings.warn(
            "The emulator is in training mode, in which rollouts obey none of its constraints but the bounds, and the"
            " network's input gets the noise of trainings: call emulator.eval() first.",
            stacklevel=4,
        )


def warn_of_start_outside(emulator: Emulator, particles: Particles) -> None:
    """Warn of particles that start outside of the bounds by more than rounding: the first frame moves them in."""
    scene = emulator.scene
    apart = distance_beyond(particles.position, scene.bounds, scene.confined).masked_fill(~particles.mask, 0.0)
    outside = apart > ROUNDING * min(emulator.grid.spacing)
    if outside.any():
        warnings.warn(
            f"{int(outside.sum())} of {int(particles.mask.sum())} particles start outside of the bounds"
            f" {list(scene.bounds)}, by up to {float(apart.max()):.3g}: rollouts move them in.",
            stacklevel=4,
        )


def beyond_walls(scene: Scene, position: Tensor) -> Tensor:
    """Whether positions (..., D) are outside of the domain, (...) bool: never along periodic axes."""
    return distance_beyond(position, scene.domain, [not wraps for wraps in scene.periodic]) > 0
