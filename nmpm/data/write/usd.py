"""Universal Scene Description, as text."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from tempfile import TemporaryFile
from typing import IO, ClassVar

import numpy as np

from nmpm.colours import Rgb, material_colours
from nmpm.data.format import TRUTH
from nmpm.data.gravity import trajectory_gravity
from nmpm.data.write.base import Clip, ClipFrame, TextWriter, pad


class Usda(TextWriter):
    """`UsdGeom.Points` for each type of particles, with positions, velocities and fields at a time code per frame.

    `timeCodesPerSecond` is 1 / dt. Particles of static types have one position. A truth has points of its own.
    """

    readers: ClassVar[str] = "Blender, Houdini, Omniverse"

    def text(self, clip: Clip) -> Iterator[str]:
        trajectory, metadata = clip.trajectory, clip.metadata
        codes, width = clip.times / metadata.dt, clip.spacing
        names = {i: metadata.particle_types.get(i, f"type{i}") for i in np.unique(trajectory.particle_type).tolist()}
        colours = material_colours(names.values())
        with ExitStack() as stack:
            clouds = [
                _Cloud(_identifier(name), i, i in metadata.static_types, colours[name], width, stack)
                for i, name in names.items()
            ]
            clouds += [
                replace(cloud, name=f"{TRUTH}_{cloud.name}", truth=True, samples={})
                for cloud in clouds
                if TRUTH in trajectory.fields and not cloud.static
            ]
            for code, frame in zip(codes, clip.frames(), strict=True):
                for cloud in clouds:
                    cloud.add(frame, code)
            low, high = (tuple(pad(np.array([corner]))[0].tolist()) for corner in np.array(metadata.bounds).T)
            gravity = np.abs(trajectory_gravity(trajectory.attributes, metadata, "trajectory") or (0.0, 0.0, 1.0))
            up = "Z" if metadata.dim == 3 and int(np.argmax(gravity)) == 2 else "Y"
            rate = f"{1 / metadata.dt:.9g}"
            yield (
                f'#usda 1.0\n(\n    defaultPrim = "particles"\n    upAxis = "{up}"\n    metersPerUnit = 1\n'
                f"    timeCodesPerSecond = {rate}\n    framesPerSecond = {rate}\n"
                f"    startTimeCode = {codes[0]:.9g}\n    endTimeCode = {codes[-1]:.9g}\n)\n\n"
                f'def Xform "particles"\n{{\n    float3[] extentsHint = [{low}, {high}]\n'
            )
            for cloud in clouds:
                yield from cloud.lines()
            yield "}\n"


@dataclass
class _Cloud:
    """The points of one type. A file has their samples by attribute, here they come by frame."""

    name: str
    type_id: int
    static: bool
    colour: Rgb
    width: float
    stack: ExitStack  # closes the temporary files
    truth: bool = False
    samples: dict[str, IO[str]] = field(default_factory=dict)  # temporary files by declared attribute
    ids: str = ""  # in the last frame

    def add(self, frame: ClipFrame, code: float) -> None:
        """Adds the samples of a frame."""
        if self.static and frame.number:
            return
        position = frame.fields[TRUTH] if self.truth else frame.position
        part = (frame.particle_type == self.type_id) & ~np.isnan(position[:, 0])
        if (ids := _list(frame.id[part])) != self.ids:
            self.ids = ids
            self._sample("int64[] ids", code, ids)
        self._sample("point3f[] points", code, _list(position[part]))
        if self.truth:
            return
        for name, values in frame.fields.items():
            if name == "velocity":
                self._sample("vector3f[] velocities", code, _list(values[part]))
            elif name != TRUTH:
                kind = "float[]" if values.ndim == 1 else "float3[]"
                declared = f"{kind} primvars:{_identifier(name)}"
                self._sample(declared, code, _list(values[part].astype(np.float32)))

    def lines(self) -> Iterator[str]:
        """The prim as text."""
        red, green, blue = (level / 255 for level in self.colour)
        yield f'\n    def Points "{self.name}"\n    {{\n'
        yield f"        color3f[] primvars:displayColor = [({red:.3g}, {green:.3g}, {blue:.3g})]\n"
        yield f'        float[] widths = [{self.width:.6g}] (interpolation = "constant")\n'
        for declared, content in self.samples.items():
            if "primvars:" in declared:
                yield f'        {declared} (interpolation = "vertex")\n'
            yield f"        {declared}.timeSamples = {{\n"
            content.seek(0)
            yield from content
            yield "        }\n"
        yield "    }\n"

    def _sample(self, declared: str, code: float, values: str) -> None:
        if declared not in self.samples:
            part = TemporaryFile("w+", encoding="utf-8")  # noqa: SIM115 (the stack closes it)
            self.samples[declared] = self.stack.enter_context(part)
        self.samples[declared].write(f"            {code:.9g}: {values},\n")


def _list(values: np.ndarray) -> str:
    """Numbers (n,) or vectors (n, 3) in brackets; float32 are read back exactly."""
    one = "%.9g" if values.dtype.kind == "f" else "%d"
    pattern = one if values.ndim == 1 else f"({one}, {one}, {one})"
    return "[" + ", ".join([pattern] * len(values)) % tuple(values.ravel().tolist()) + "]"


def _identifier(name: str) -> str:
    """A name of letters, digits and underscores that does not begin with a digit."""
    return re.sub(r"\W|^(?=\d)", "_", name, flags=re.ASCII)
