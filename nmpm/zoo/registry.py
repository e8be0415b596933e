"""The model zoo: pretrained emulators with cards that state their errors and their training.

An entry is a folder `<name>` (or `<dataset>/<variant>`) of

    card.yaml           training, measured errors, the weights' SHA-256
    config.yaml         the emulator's recipe: scene, grid, transfer, processor, decoder
    model.safetensors   weights and normalisation statistics
    README.md           the card for reading

There are two zoos: the one that ships with the package, and the user's own (see `user_zoo`), which comes first.
Torch is imported where a model is loaded, so that names are looked up, and refused, at once.
"""

from __future__ import annotations

import builtins
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nmpm._support.machine import device_name, find_device
from nmpm._support.messages import one_line, suggestion
from nmpm._support.shipped import entry_names, shipped_folder, user_zoo
from nmpm.errors import ConfigError, ZooError
from nmpm.zoo.card import BEST, CARD, LAST, preset_of, read_card, stated_error, stated_milliseconds
from nmpm.zoo.hub import HubId, download

if TYPE_CHECKING:
    import torch

    from nmpm.zoo.pretrained import Pretrained


@dataclass(frozen=True)
class Limits:
    """What a chosen model must keep to, and whose times count.

    Args:
        max_mse: Largest full-rollout MSE on the test scenes, in length².
        max_ms_per_frame: Largest time per frame of one scene.
        hardware: Whose stated times count; those of this machine when left out.
        calibrate: Whether the variants are timed now instead.

    Raises:
        ConfigError: if a limit is not a positive number, or whose times count is ambiguous or of no use.
    """

    max_mse: float | None = None
    max_ms_per_frame: float | None = None
    hardware: str | None = None
    calibrate: bool = False

    def __post_init__(self) -> None:
        for name in ("max_mse", "max_ms_per_frame"):
            value = getattr(self, name)
            if value is not None and (isinstance(value, bool) or not isinstance(value, Real) or not float(value) > 0):
                raise ConfigError(f"{name} = {value!r} must be a positive number, or be left out.")
        if not self and (self.calibrate or self.hardware is not None):
            raise ConfigError("calibrate and hardware are of use with a limit: give max_mse or max_ms_per_frame too.")
        if self.calibrate and self.hardware is not None:
            raise ConfigError(
                f"calibrate times the models here, hardware = {self.hardware!r} takes stated times: give one."
            )

    def __bool__(self) -> bool:
        return self.max_mse is not None or self.max_ms_per_frame is not None


def choose(cards: Mapping[str, Mapping[str, Any]], limits: Limits, times: Mapping[str, float]) -> str:
    """The model within the limits: the most accurate if time is limited, else the fastest, else the most accurate.

    Models whose cards state no error are left out; so are those of unknown times where the others' are known.

    Args:
        cards: Of the variants, by name.
        limits: What it must keep to.
        times: Milliseconds per frame, of the variants of which they are known.

    Raises:
        ZooError: if none is within the limits, or times are needed of which none is known.
    """
    errors = {name: mse for name, card in cards.items() if (mse := stated_error(card)) is not None}
    if limits.max_ms_per_frame is not None and errors and not times:
        hardware = sorted({hardware for name in errors for hardware in stated_milliseconds(cards[name])})
        elsewhere = f", but on {'; '.join(hardware)} (hardware=…)" if hardware else ""
        raise ZooError(
            f"The cards of {', '.join(sorted(errors))} state no time on {limits.hardware or 'this machine'}{elsewhere}."
            " Give calibrate=True to time them here."
        )
    accurate = [name for name, mse in errors.items() if limits.max_mse is None or mse <= limits.max_mse]
    timed = [name for name in accurate if name in times]
    if limits.max_ms_per_frame is not None:
        within = [name for name in timed if times[name] <= limits.max_ms_per_frame]
    else:
        within = timed or accurate
    if not within:
        figures = "; ".join(
            f"{name}: MSE {mse:.3g}" + (f", {times[name]:.3g} ms" if name in times else "")
            for name, mse in errors.items()
        )
        raise ZooError(f"No model is within the limits. {figures or 'None states an error.'}")
    by_time = limits.max_ms_per_frame is None and bool(timed)
    return min(within, key=times.__getitem__ if by_time else errors.__getitem__)


NAME_LENGTH = 100
"""Longest name of an entry."""
NAME = re.compile(r"[a-z0-9][a-z0-9_-]*(/[a-z0-9][a-z0-9_-]*)?")

Root = str | Path | None
"""Folder of a zoo; None for the user's and the shipped one."""


class Zoo:
    """The pretrained models: the user's own and those that came with the package, or those of another folder."""

    @staticmethod
    def list(root: Root = None) -> builtins.list[str]:
        """Names of the models; raises ZooError if `root` is given and is not a folder."""
        names = {name for folder in _roots(root) for name in entry_names(folder) if _is_name(name)}
        return sorted(names)

    @staticmethod
    def folder(name: str, root: Root = None) -> Path:
        """The folder of a model's entry; raises ZooError, naming similar ones, if there is none of that name."""
        check_name(name)
        for zoo in _roots(root):
            if (zoo / name / CARD).exists():
                return zoo / name
        raise _unknown_model(name, root)

    @staticmethod
    def card(name: str, root: Root = None) -> dict[str, Any]:
        """What a model is, how it was trained and what its errors are; raises ZooError if the card is damaged."""
        return read_card(Zoo.folder(name, root))

    @staticmethod
    def variants(name: str, root: Root = None) -> builtins.list[str]:
        """Names of the models of a dataset, `name` itself and `name/…`; raises ZooError if there is none."""
        variants = [other for other in Zoo.list(root) if other == name or other.startswith(f"{name}/")]
        if not variants:
            raise _unknown_model(name, root)
        return variants

    @staticmethod
    def load(
        name: str | Path,
        root: Root = None,
        device: torch.device | str = "cpu",
        *,
        variant: str | None = None,
        max_mse: float | None = None,
        max_ms_per_frame: float | None = None,
        hardware: str | None = None,
        calibrate: bool = False,
    ) -> Pretrained:
        """A pretrained model, or one of your own; see `load_model`.

        With a limit, the one of `Zoo.variants(name)` that keeps it: the most accurate within a time, or the fastest
        within an error.

        Args:
            name: As for `load_model`, and so are the next two.
            root: Folder of a zoo.
            device: Where to compute.
            variant: "fast" for `name/fast`.
            max_mse: Largest full-rollout MSE of its card, in length².
            max_ms_per_frame: Largest time per frame of one scene, as the cards state it for `hardware`.
            hardware: As cards name it; this machine's when left out.
            calibrate: Time the variants on `device` now instead.

        Raises:
            ZooError: as `load_model`; or if no variant is within the limits, or their times are not known.
            ConfigError: if a limit is not a positive number; if `hardware` or `calibrate` is given without a limit, or
                both are; if `variant` or a limit is given for a path or an id.
        """
        limits = Limits(max_mse, max_ms_per_frame, hardware, calibrate)
        if variant is None and not limits:
            return load_model(name, device, root)
        _check_variants(name, root)
        full_name = str(name) if variant is None else f"{name}/{variant}"
        if limits:
            full_name = _choose_variant(full_name, limits, root, find_device(device))
        return load_model(full_name, device, root)


def load_model(model: str | Path, device: torch.device | str = "cpu", root: Root = None) -> Pretrained:
    """The model of a name or path.

    Args:
        model: One of `Zoo.list()`; or, if there is none of that name, the path of a zoo entry, of a run (of which the
            best checkpoint is taken, without validation the last) or of a checkpoint; or "owner/repository@revision" of
            the Hugging Face hub.
            `./goop` is always a path.
        device: Where to compute: "cpu", "cuda", "mps", or "auto" for a GPU where there is one.
        root: Folder of a zoo, in which alone the name is looked up: with it, `model` cannot be a path.

    Raises:
        ZooError: if there is no such model; or an entry's file is missing or damaged, or its weights are not those of
            its card.
        DataError: if a checkpoint cannot be read.
        ConfigError: if this machine does not have the device, or a newer nmpm wrote the model.
    """
    from nmpm.zoo.entries import load_checkpoint, load_entry  # imports torch

    target = find_device(device)
    path = find_model(model, root)
    if not path.is_dir():
        return load_checkpoint(path).to(target)
    if (path / CARD).exists():
        return load_entry(path).to(target)
    for checkpoint in (path / BEST, path / LAST):
        if checkpoint.exists():
            return load_checkpoint(checkpoint).to(target)
    raise ZooError(f"{path} holds no model: neither an entry of the zoo ({CARD}) nor a run ({BEST}).")


def find_model(model: str | Path, root: Root = None) -> Path:
    """The folder or checkpoint that a name, a path or an id means, as for `load_model`; an id is downloaded."""
    place = locate_model(model, root)
    return download(place) if isinstance(place, HubId) else place


def locate_model(model: str | Path, root: Root = None) -> Path | HubId:
    """As `find_model`, but downloads nothing; raises ZooError if there is no such model."""
    name, path = str(model), Path(model)
    # `Path("goop")` is always a path.
    in_zoo = isinstance(model, str) and _is_name(model) and any((zoo / model / CARD).exists() for zoo in _roots(None))
    if root is not None or in_zoo:
        return Zoo.folder(name, root)
    if path.suffix == ".ckpt" or _exists(path):
        return path
    identifier = HubId.parse(name)
    if identifier is None:
        raise _unknown_model(name)
    return identifier


def find_entry(model: str | Path, root: Root = None) -> Path:
    """As `find_model`, for what needs a card: raises ZooError for a run or a checkpoint."""
    folder = find_model(model, root)
    if not (folder / CARD).exists():
        raise ZooError(
            f"{one_line(folder)} has no {CARD}: `nmpm zoo add RUN NAME` makes an entry of a run, with a card."
        )
    return folder


def find_writable(model: str, root: Path | None = None) -> Path:
    """The folder of an entry to refresh: of that name in the user's own zoo or in `root`, or at that path.

    Raises:
        ConfigError: if it is on the hub.
        ZooError: if there is none.
    """
    if root is None and not (user_zoo().is_dir() and model in Zoo.list(user_zoo())):
        if Path(model).is_dir():
            return find_entry(Path(model))
        if HubId.parse(model) is not None:
            raise ConfigError(
                f"{model} is on the hub: `nmpm zoo pull {model} NAME` makes an entry of it; refresh that."
            )
    return Zoo.folder(model, user_zoo() if root is None else root)


def load_models(names: Sequence[str]) -> dict[str, Pretrained]:
    """Models by name; those of runs and entries by the folder's name where that is unique."""
    short = {name: Path(name).name if Path(name).is_dir() else name for name in names}
    unique = len(set(short.values())) == len(short)
    return {short[name] if unique else name: load_model(name) for name in names}


def load_models_of(dataset: str) -> tuple[dict[str, Pretrained], list[ZooError]]:
    """The zoo's models of a simulated dataset by name, and why damaged ones are left out."""
    models, left_out = dict[str, "Pretrained"](), list[ZooError]()
    for name in Zoo.list():
        try:
            if preset_of(Zoo.card(name)) == dataset:
                models[name] = load_model(name)
        except ZooError as error:
            left_out.append(error)
    return models, left_out


def check_name(name: str) -> None:
    """Raise ZooError for a name that an entry cannot have, such as one that would lead out of the zoo."""
    if not _is_name(name):
        raise ZooError(
            f"{one_line(repr(name), NAME_LENGTH)} cannot name a model: use at most {NAME_LENGTH} lower-case letters,"
            " digits, - and _, with at most one / between dataset and variant."
        )


def _choose_variant(name: str, limits: Limits, root: Root, device: torch.device) -> str:
    """The variant within the limits; damaged ones are left out.

    Raises:
        ZooError: if all cards are damaged, or as `choose`.
    """
    cards, damaged = {}, []
    for variant in Zoo.variants(name, root):
        try:
            cards[variant] = Zoo.card(variant, root)
        except ZooError as error:
            damaged.append(error)
    if damaged and not cards:
        raise damaged[0]
    from nmpm.zoo.measures.speed import measure_speed  # imports torch

    machine, times = limits.hardware or device_name(device), {}
    for variant, card in cards.items():
        if limits.calibrate:
            with suppress(ZooError):  # damaged
                times[variant] = float(measure_speed(load_model(variant, device, root))["ms_per_frame"])
        elif machine in (stated := stated_milliseconds(card)):
            times[variant] = stated[machine]
    return choose(cards, limits, times)


def _check_variants(model: str | Path, root: Root) -> None:
    """Raise ConfigError for a model that is given by a path or an id, not by a name, of which there may be variants."""
    named = root is not None or (
        isinstance(model, str) and any(f"{name}/".startswith(f"{model}/") for name in Zoo.list())
    )
    if not named and (_exists(Path(model)) or HubId.parse(str(model)) is not None):
        raise ConfigError(
            f"{one_line(model)} is one model: variant, max_mse and max_ms_per_frame choose among those of a name in the"
            " zoo. Leave them out; or, for a folder of several models, give root=FOLDER and a name within it."
        )


def _unknown_model(name: str, root: Root = None) -> ZooError:
    names = Zoo.list(root)
    datasets = {other: other.partition("/")[0] for other in names}
    dataset = name.partition("/")[0]
    if variants := [other for other in names if datasets[other] == dataset != name]:
        near = f" Of {dataset} it has {', '.join(variants)}."
    else:
        near = suggestion(name[:NAME_LENGTH], sorted({*names, *datasets.values()}))
    path = " No such path exists either." if root is None and not _exists(Path(name)) else ""
    shown, held = one_line(repr(name), NAME_LENGTH), sorted(set(datasets.values()))
    return ZooError(f"The zoo holds no model {shown}; it holds {', '.join(held) or 'none'}.{near}{path}")


def _is_name(name: str) -> bool:
    return len(name) <= NAME_LENGTH and NAME.fullmatch(name) is not None


def _exists(path: Path) -> bool:
    """Whether a path exists; False for a name that is too long, or has a null character."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def _roots(root: Root) -> tuple[Path, ...]:
    if root is None:
        return user_zoo(), shipped_folder("zoo")
    if not _exists(Path(root)) or not Path(root).is_dir():
        raise ZooError(f"There is no zoo in {one_line(root)}: it is not a folder.")
    return (Path(root),)
