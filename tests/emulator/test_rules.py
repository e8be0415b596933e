"""The tables of what runs where hold: calls with each feature take, or do not take, each engine."""

import dataclasses
from contextlib import nullcontext

import pytest
import torch

from nmpm.backends import ENGINES
from nmpm.decoders import Residual
from nmpm.emulator.engines import rules
from nmpm.emulator.engines.engine import EngineForm
from nmpm.emulator.engines.rules import CALLS, MODELS, NETWORKS, Call, call_form
from nmpm.emulator.runtimes import Windows
from nmpm.errors import ConfigError
from nmpm.grid import Grid
from nmpm.processors import FNO
from nmpm.transfer import Affine, Quadratic
from nmpm.zoo.export.parts import Network, Step
from tests.scenes import box, cloud, emulator_of

OPEN = {"boundary": ("open", "wall")}
FAR = {"bounds": ((1e6, 1e6 + 0.8), (0.1, 0.9)), "domain": ((1e6 - 0.02, 1e6 + 0.82), (0.08, 0.92))}


class OwnDecoder(Residual):
    """Of another package."""


class MovedGrid(Grid):
    """Of a recorded training step."""


WITH_FEATURE = {
    "one dimension": lambda: emulator_of(box(1)),
    "three dimensions": lambda: emulator_of(box(3), 8),
    "fields": lambda: emulator_of(box(evolving=("heat",))),
    "obstacles that move": lambda: emulator_of(box(obstacles=True, moving_obstacles=True)),
    "rest beside open axes": lambda: emulator_of(box(**OPEN), rest_speed=0.1),
    "the transfers Nearest and Quadratic": lambda: emulator_of(box(), transfer=Quadratic()),
    "other transfers": lambda: emulator_of(box(), transfer=Affine()),
    "another package's decoder": lambda: emulator_of(box(), decoder=OwnDecoder()),
    "bounds: reflect": lambda: emulator_of(box(), bounds="reflect"),
    "bounds: error": lambda: emulator_of(box(), bounds="error"),
    "a domain too far from the origin for float32": lambda: emulator_of(box(**FAR)),
}
"""An emulator of each feature of `MODELS`."""


def changed(state, **changes):
    return dataclasses.replace(state, **changes)


CHANGES = {
    "a CPU": lambda patch, _, state: patch.setattr(Call, "device", "cpu"),
    "a CUDA GPU": lambda patch, _, state: patch.setattr(Call, "device", "cuda"),
    "other devices": lambda patch, _, state: patch.setattr(Call, "device", "mps"),
    "rollouts": lambda _, emulator, state: emulator.eval() and None,
    "trainings": lambda _, emulator, state: emulator.train() and None,
    "float64": lambda *_: _[-1].double(),
    "moving obstacles in the state": lambda *_: changed(_[-1], obstacle_velocity=torch.zeros_like(_[-1].obstacle)),
    "sizes of particles": lambda *_: changed(_[-1], volume=2 * torch.ones(_[-1].mask.shape)),
    "several sizes in a scene": lambda *_: changed(_[-1], volume=1 + torch.rand(_[-1].mask.shape)),
    "gradients of gravity, obstacles or numbers of a scene": lambda *_: changed(
        _[-1], gravity=_[-1].gravity.clone().requires_grad_()
    ),
    "gradients of a rollout": lambda *_: changed(_[-1], velocity=_[-1].velocity.clone().requires_grad_()),
    "a recorded training step, which moves its grid": lambda _, emulator, state: setattr(
        emulator, "grid", MovedGrid(**vars(emulator.grid))
    ),
    "graphs that torch.compile traces": lambda patch, *_: patch.setattr(torch.compiler, "is_compiling", lambda: True),
    "nmpm.transfer.without_kernels": lambda patch, *_: patch.setattr(rules, "kernels_are_on", lambda: False),
    "deterministic algorithms": lambda patch, *_: patch.setattr(
        torch, "are_deterministic_algorithms_enabled", lambda: True
    ),
}
"""Changes of a call, its emulator or its state, that give it each feature of `CALLS`."""


FORMS = {form.name: form for form in ENGINES["numba"]}


def takes_form(form: EngineForm, emulator, state, change, monkeypatch) -> bool:
    """Whether a call that would otherwise be computed by a form of an engine is, after a change."""
    training = "trainings" in form.features
    emulator = emulator.train(training).requires_grad_(training)
    solid = emulator.solid(state)
    state = change(monkeypatch, emulator, state) or state
    return call_form(emulator, state, solid) == form


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
@pytest.mark.parametrize("rule", MODELS, ids=lambda rule: rule.feature)
def test_a_model_with_a_feature_is_computed_by_the_forms_that_take_it(rule, form, monkeypatch):
    emulator = WITH_FEATURE[rule.feature]()
    state = cloud(emulator.scene)
    state = state.with_fields({name: torch.zeros(1, 30) for name in emulator.scene.fields})
    assert rule.holds(emulator.recipe)
    assert takes_form(form, emulator, state, lambda *_: None, monkeypatch) == (rule.feature in form.features)


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
@pytest.mark.parametrize("rule", CALLS, ids=lambda rule: rule.feature)
def test_a_call_with_a_feature_is_computed_by_the_forms_that_take_it(rule, form, monkeypatch):
    taken = takes_form(form, emulator_of(box()), cloud(box()), CHANGES[rule.feature], monkeypatch)
    assert taken == (rule.feature in form.features)


@pytest.mark.parametrize("form", FORMS.values(), ids=FORMS)
def test_a_plain_call_is_computed_by_each_form(form, monkeypatch):
    assert takes_form(form, emulator_of(box()), cloud(box()), lambda *_: None, monkeypatch)
    assert form.features <= {rule.feature for rule in (*MODELS, *CALLS)}


def test_another_engine_is_chosen_by_name():
    emulator, state = emulator_of(box()).requires_grad_(False), cloud(box())
    by_torch = emulator.with_engine("torch")
    assert call_form(by_torch, state, emulator.solid(state)) is None
    assert by_torch.unconstrained().engine == "torch"
    assert by_torch.explain().splitlines()[1] == "  rollouts   torch's operations"
    assert call_form(by_torch.with_engine("numba"), state, emulator.solid(state)).name == "numba"
    with pytest.raises(ConfigError, match=r"no engine 'nunba'; there are torch, numba.*Did you mean numba\?"):
        emulator.with_engine("nunba")
    with pytest.raises(ConfigError, match="The engine numba does not take other transfers"):
        emulator_of(box(), transfer=Affine()).with_engine("numba")


def test_runtimes_take_plain_models_and_not_those_of_their_rows():
    assert not Windows().unsupported_reason(emulator_of(box()))
    fno = emulator_of(box(), processor=FNO(width=4, layers=1, modes=2))
    assert Windows().unsupported_reason(fno) == f"{NETWORKS[-1].feature}: use eager"


@pytest.mark.parametrize(
    ("feature", "part", "is_carried"),
    [
        ("fields", Step, False),
        ("obstacles that move", Step, False),
        ("bounds: error", Step, False),
        ("bounds: error", Network, True),
    ],
)
def test_exports_carry_the_features_of_their_part(feature, part, is_carried):
    with nullcontext() if is_carried else pytest.raises(ConfigError, match=f"do not carry: {feature}"):
        part(WITH_FEATURE[feature]())


def test_an_emulator_explains_what_runs_and_why_nothing_faster_does(monkeypatch):
    plain, heat = emulator_of(box()), emulator_of(box(evolving=("heat",)))
    lines = plain.explain().splitlines()
    assert lines[:3] == ["On cpu:", "  rollouts   Numba kernels", "  trainings  Numba kernels with gradients"]
    assert lines[4] == "  recorded   no CUDA graphs: devices other than a CUDA GPU"
    monkeypatch.setattr(Call, "device", "cuda")
    on_gpu = heat.explain()
    assert "rollouts   torch's operations; Numba kernels do not take a CUDA GPU" in on_gpu
    assert "recorded   as CUDA graphs" in on_gpu
    three = emulator_of(box(3), 8).explain()
    assert "trainings  torch's operations; Numba kernels with gradients do not take three dimensions" in three
