"""Adaptation: the weights and statistics of an emulator in a recipe whose scene has other channels.

Channels are matched by name. Added inputs get zero weights, dropped ones are replaced by the constant that they have
where nothing is, and added materials move as the decoder alone says: where a scene has nothing in what is added or
dropped, the adapted emulator predicts what the original does.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from nmpm.emulator.model import Emulator
from nmpm.emulator.recipe import EmulatorRecipe
from nmpm.errors import ConfigError
from nmpm.processors import GridLayout, Stochastic, Turned
from nmpm.processors.channels import ChannelChange, OutputSource
from nmpm.scene import Scene, Turn

_SOLID_STD = 0.25
"""Standard deviation of an added solid channel: that of walls and obstacles in a fifteenth of the cells."""
_GRAVITY = 0.004
"""Cells per frame²: the size of gravity, for the statistics of its channels, where the emulator's scenes had none."""


@torch.no_grad()
def adapted(emulator: Emulator, recipe: EmulatorRecipe) -> Emulator:
    """A copy of an emulator's weights and statistics in an emulator of another recipe.

    Cells, scene and constraints may differ. Added inputs have mean 0, no limits, and the standard deviation of the same
    quantity of other materials; added outputs the scale of that. A network whose first layer pads its input with zeros
    (those of the zoo do not) sees a step at the walls in a dropped input whose normalised constant is not 0.

    Raises:
        ConfigError: if the processor, the number of frames or of axes differ, or channels do and the processor does not
            say which of its layers depend on them.
    """
    if not (recipe.turn.is_identity and emulator.recipe.turn.is_identity):
        # Channels are matched in the network's own axes.
        return turned(adapted(turned(emulator, emulator.recipe.turn), recipe.turned(recipe.turn)), recipe.turn.inverse)
    old, scene, processor = emulator.scene, recipe.scene, recipe.processor
    if isinstance(processor, Stochastic) and processor.processor == emulator.recipe.processor:
        emulator = with_noise(emulator, processor)
    for name, before, after in (
        ("processor", emulator.recipe.processor, recipe.processor),
        ("frames", emulator.frames, recipe.frames),
        ("dim", old.dim, scene.dim),
    ):
        if before != after:
            raise ConfigError(f"The emulator's weights are for {name} = {before}, not {after}.")
    other = _built_like(emulator, recipe)
    if _channels(old) == _channels(scene):
        other.load_state_dict(emulator.state_dict())
    else:
        other.load_state_dict(other.state_dict() | _statistics(emulator, other) | _weights(emulator, other))
    return _with_mode_of(emulator, other)


@torch.no_grad()
def turned(emulator: Emulator, turn: Turn) -> Emulator:
    """A copy of an emulator for its scene in other axes, to which the turn leads from its own.

    It predicts what the emulator does, turned: exactly, but for the rounding of mirrored positions.
    """
    recipe, old, state = emulator.recipe.turned(turn), emulator.scene, emulator.state_dict()
    if turn.is_identity:
        return emulator
    inputs, outputs, fields = (turn.channels(names) for names in (old.input_channels, old.output_channels, old.fields))
    low, high = state["input_low"], state["input_high"]
    statistics = {
        "calibrated": state["calibrated"],
        "input_mean": _signed(state["input_mean"], inputs),
        "input_std": state["input_std"][[at for at, _ in inputs]],
        "input_low": torch.stack([-high[at] if mirror else low[at] for at, mirror in inputs]),
        "input_high": torch.stack([-low[at] if mirror else high[at] for at, mirror in inputs]),
        "output_scale": state["output_scale"][:, [at for at, _ in outputs]],
    }
    if fields:
        statistics["field_scales.mean"] = _signed(state["field_scales.mean"], fields)
        statistics["field_scales.std"] = state["field_scales.std"][[at for at, _ in fields]]
    before, after = (
        "processor.network." if isinstance(each.processor, Turned) else "processor."
        for each in (emulator.recipe, recipe)
    )
    weights = {name: values for name, values in state.items() if name.startswith("processor.")}
    other = _built_like(emulator, recipe)
    other.load_state_dict(statistics | {after + name.removeprefix(before): values for name, values in weights.items()})
    return _with_mode_of(emulator, other)


def _signed(values: Tensor, channels: Sequence[tuple[int, bool]]) -> Tensor:
    """Values (C, …) of the channels of a turn."""
    return torch.stack([-values[at] if mirror else values[at] for at, mirror in channels])


def with_members(recipe: EmulatorRecipe, members: int) -> EmulatorRecipe:
    """The recipe whose processor reads noise, if there are to be several members."""
    if isinstance(recipe.processor, Turned):
        return with_members(recipe.turned(recipe.turn), members).turned(recipe.turn.inverse)
    if members == 1 or isinstance(recipe.processor, Stochastic):
        return recipe
    return dataclasses.replace(recipe, processor=Stochastic(recipe.processor))


@torch.no_grad()
def with_noise(emulator: Emulator, processor: Stochastic | None = None) -> Emulator:
    """A copy of an emulator whose network also reads noise, which changes nothing before a training.

    Raises ConfigError if the network does not say which of its layers depend on channels.
    """
    if isinstance(emulator.recipe.processor, Turned):
        turn = emulator.recipe.turn
        return turned(with_noise(turned(emulator, turn), processor), turn.inverse)
    processor = Stochastic(emulator.recipe.processor) if processor is None else processor
    if (layers := emulator.processor.channel_layers) is None:
        kind = type(emulator.recipe.processor).__name__
        raise ConfigError(f"{kind} names no channel_layers, so that noise cannot be added to trained weights.")
    other = _built_like(emulator, dataclasses.replace(emulator.recipe, processor=processor))
    inputs, outputs = len(emulator.scene.input_channels), len(emulator.scene.output_channels)
    change = ChannelChange(
        layers,
        GridLayout.of(emulator.scene, emulator.frames),
        [*range(inputs), *[None] * other.processor.noise],
        [OutputSource(channel) for channel in range(outputs)],
        emulator.input_mean,
    )
    weights = change.weights(emulator.processor.state_dict())
    kept = {name: values for name, values in emulator.state_dict().items() if not name.startswith("processor.")}
    other.load_state_dict(kept | {f"processor.network.{name}": values for name, values in weights.items()})
    return _with_mode_of(emulator, other)


def _built_like(emulator: Emulator, recipe: EmulatorRecipe) -> Emulator:
    """An emulator of a recipe, with the device and precision of another."""
    with torch.random.fork_rng(devices=[]):  # the weights drawn here are replaced
        other = recipe.build().to(emulator.device)
    if other.network_precision != emulator.network_precision:
        other.processor.to(emulator.network_precision)
    return other


def _with_mode_of(emulator: Emulator, other: Emulator) -> Emulator:
    """The other emulator with the runtime and mode of the first, and its frozen weights frozen."""
    frozen = {name for name, weight in emulator.named_parameters() if not weight.requires_grad}
    for name, weight in other.named_parameters():
        names = {
            name,
            name.replace("processor.network.", "processor."),
            name.replace("processor.", "processor.network."),
        }
        weight.requires_grad_(not names & frozen)
    other.runtime = copy.deepcopy(emulator.runtime)
    return other.train(emulator.training)


def _channels(scene: Scene) -> tuple[tuple[str, ...], ...]:
    return scene.input_channels, scene.output_channels, scene.fields


def _statistics(emulator: Emulator, other: Emulator) -> dict[str, Tensor]:
    """The other's statistics: those of channels and fields of the same name, and neutral ones."""
    old, new, state = emulator.scene, other.scene, emulator.state_dict()
    result = {"calibrated": emulator.calibrated}
    for name in ("input_mean", "input_low", "input_high"):
        result[name] = _by_name(state[name], old.input_channels, getattr(other, name), new.input_channels)
    result["input_std"] = torch.stack([_input_std(emulator, name) for name in new.input_channels])
    result["output_scale"] = torch.stack([_output_scale(emulator, name) for name in new.output_channels], dim=1)
    for name in ("mean", "std") if new.fields else ():
        neutral = getattr(other.field_scales, name)
        before = getattr(emulator.field_scales, name) if old.fields else neutral[:0]
        result[f"field_scales.{name}"] = _by_name(before, old.fields, neutral, new.fields)
    return result


def _by_name(values: Tensor, names: Sequence[str], neutral: Tensor, new_names: Sequence[str]) -> Tensor:
    """Values (C', ...) by new names: of the same name, else neutral ones (C', ...)."""
    rows = [values[names.index(name)] if name in names else row for name, row in zip(new_names, neutral, strict=True)]
    return torch.stack(rows)


def _like(name: str, names: Sequence[str]) -> list[int]:
    """Indices of the channel of that name, or else of those of the same quantity of other materials."""
    if name in names:
        return [names.index(name)]
    quantity = name.partition(".")[2]
    return [index for index, other in enumerate(names) if quantity and other.partition(".")[2] == quantity]


def _input_std(emulator: Emulator, name: str) -> Tensor:
    """The standard deviation (1, ...) of an input channel."""
    if like := _like(name, emulator.scene.input_channels):
        return emulator.input_std[like].mean(0)
    value = _SOLID_STD if name == "solid" else 1.0
    if name.startswith("gravity_"):
        size = float(torch.linalg.vector_norm(_gravity(emulator.recipe))) or _GRAVITY
        value = size / emulator.scene.dim**0.5
    return torch.full_like(emulator.input_std[0], value)


def _output_scale(emulator: Emulator, name: str) -> Tensor:
    """The scale (m, ...) of an output channel."""
    like = _like(name, emulator.scene.output_channels)
    return emulator.output_scale[:, like].mean(1) if like else torch.ones_like(emulator.output_scale[:, 0])


def _gravity(recipe: EmulatorRecipe) -> Tensor:
    """The scene's gravity (D,) in cells per frame²; 0 where it varies or is not known."""
    fall = torch.tensor(recipe.scene.gravity or (0.0,) * recipe.scene.dim, dtype=torch.float64) * recipe.scene.dt**2
    return recipe.grid.to_cell_displacement(fall, torch.float64)


def _weights(emulator: Emulator, other: Emulator) -> dict[str, Tensor]:
    """The weights of the other's network."""
    layers = emulator.processor.channel_layers
    if layers is None:
        kind = type(emulator.recipe.processor).__name__
        raise ConfigError(
            f"{kind} cannot be given other channels ({_differences(emulator.scene, other.scene)}): its network names no"
            " channel_layers, see nmpm.processors.ChannelLayers."
        )
    old, new = emulator.scene, other.scene
    before, rates = old.input_channels, old.output_channels
    change = ChannelChange(
        layers,
        GridLayout.of(old, emulator.frames),
        [before.index(name) if name in before else None for name in new.input_channels],
        [OutputSource((_like(name, rates) or [0])[0], name not in rates) for name in new.output_channels],
        _absent(emulator, other.recipe),
    )
    weights = change.weights(emulator.processor.state_dict())
    return {f"processor.{name}": values for name, values in weights.items()}


def _absent(emulator: Emulator, recipe: EmulatorRecipe) -> Tensor:
    """(C_in,) the normalised input channels of an emulator where nothing is, in the scene of another recipe."""
    empty, gravity = torch.zeros_like(emulator.input_mean), _gravity(recipe)
    for index, name in enumerate(emulator.scene.input_channels):
        if name.startswith("gravity_"):
            empty[index] = gravity["xyz".index(name[-1])]
    return emulator.normalise(empty.unsqueeze(0)).flatten()


def _differences(old: Scene, new: Scene) -> str:
    """Names of the channels that differ, as added (+) and dropped (-)."""
    before, after = (dict.fromkeys((*scene.input_channels, *scene.output_channels)) for scene in (old, new))
    added = [f"+{name}" for name in after if name not in before]
    dropped = [f"-{name}" for name in before if name not in after]
    return " ".join(added + dropped) or "in another order"
