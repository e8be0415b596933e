"""What was played, to be written as a trajectory: particles that appear, and bodies that are moved."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from nmpm.data.format import Trajectory
from nmpm.data.predictions import predicted_trajectory
from nmpm.errors import DataError
from nmpm.obstacles import Body
from nmpm.particles import Particles
from nmpm.scene import Scene

MOST_BYTES = 2**27
"""Of the positions that are kept; older frames are forgotten."""
_FEWEST = 3


class PlayedFrames:
    """The last frames that were played: positions (N, D), and the bodies by id."""

    def __init__(self) -> None:
        self._frames: deque[tuple[Tensor, Mapping[int, Body]]] = deque()
        self._bytes, self.forgotten = 0, 0

    def __len__(self) -> int:
        return len(self._frames)

    def add(self, position: Tensor, bodies: Mapping[int, Body]) -> None:
        """Keep a frame, positions (N, D) of which there are never fewer, and bodies by id."""
        self._frames.append((position.float().cpu(), dict(bodies)))
        self._bytes += self._frames[-1][0].nbytes
        while self._bytes > MOST_BYTES and len(self._frames) > _FEWEST:
            self._bytes -= self._frames.popleft()[0].nbytes
            self.forgotten += 1

    def trajectory(self, scene: Scene, material: Tensor, gravity: Tensor, static: Tensor, model: str) -> Trajectory:
        """All of it, NaN where a particle is not there yet or no longer.

        Args:
            scene: The model's.
            material: (N,) of all particles.
            gravity: (1, D) in length per frame squared, the last.
            static: (1, M, D) obstacles beside the bodies.
            model: What predicted, in words.

        Raises:
            DataError: if there are fewer than three frames.
        """
        if len(self._frames) < _FEWEST:
            raise DataError("nothing was played yet: let it run for some frames first")
        count, dim = len(material), static.shape[-1]
        path = torch.full((len(self._frames), count, dim), torch.nan)
        for row, (position, _) in zip(path, self._frames, strict=True):
            row[: len(position)] = position
        obstacles = self._obstacle_frames(scene, static)
        moves = bool((obstacles != obstacles[:1]).any())
        state = Particles(
            position=path[1:2],
            velocity=path[1:2] - path[0:1],
            material=material[None],
            mask=path[:2].isfinite().all(-1).all(0, keepdim=True),
            obstacle=obstacles[1:2],
            obstacle_mask=torch.ones(1, obstacles.shape[1], dtype=torch.bool),
            gravity=gravity,
        )
        everyone = torch.ones_like(state.mask)
        frames = obstacles[None] if moves else None
        return predicted_trajectory(scene, state, path[None, 2:], model, real=everyone, obstacle_frames=frames)

    def _obstacle_frames(self, scene: Scene, static: Tensor) -> Tensor:
        """(T, M, D) particles that fill the bodies, NaN where one is not there, after those that stay."""
        length, columns = len(self._frames), [static.float().cpu().expand(len(self._frames), -1, -1)]
        for number in sorted({number for _, bodies in self._frames for number in bodies}):
            filled: dict[int, Tensor] = {}  # by the body, which is the same object in frames between moves
            rows = []
            for body in (bodies.get(number) for _, bodies in self._frames):
                if body is not None and id(body) not in filled:
                    filled[id(body)] = body.particles(scene.particle_spacing).float()
                rows.append(None if body is None else filled[id(body)])
            like = next(row for row in rows if row is not None)
            columns.append(torch.stack([torch.full_like(like, torch.nan) if row is None else row for row in rows]))
        return torch.cat(columns, dim=1).reshape(length, -1, static.shape[-1])


def free_name(path: Path) -> Path:
    """The path, or with the first number for which there is no file."""
    numbered = (path.with_stem(f"{path.stem}-{number}") for number in range(2, 10_000))
    return next(name for name in (path, *numbered) if not name.exists())
