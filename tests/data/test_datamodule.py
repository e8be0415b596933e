import json
from collections import Counter
from itertools import islice
from types import SimpleNamespace

import pytest
import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint, OnExceptionCheckpoint

from nmpm.data.convert import Options
from nmpm.data.datamodule import TrajectoryDataModule
from nmpm.data.format import METADATA_FILE
from nmpm.data.inspection import inspect
from nmpm.data.sources import FolderSource
from nmpm.errors import ConfigError, DataError
from nmpm.particles import Window

TRAIN = ((12, 5), (9, 7), (14, 6), (7, 3), (8, 4))

pytestmark = pytest.mark.filterwarnings("ignore:`isinstance.treespec", "ignore:.*was called without a model")


class Recorder(LightningModule):
    """Learns something that depends on every batch, and remembers what it saw."""

    def __init__(self, fail_at: int | None = None) -> None:
        super().__init__()
        self.offset = torch.nn.Parameter(torch.zeros(2))
        self.fail_at, self.seen, self.evaluated = fail_at, list[float](), list[torch.Size]()

    def training_step(self, batch: Window, batch_idx: int) -> torch.Tensor:
        if len(self.seen) == self.fail_at:
            raise RuntimeError("interrupted")
        self.seen.append(float(batch.frames.double().sum()))
        moved = batch.frames + self.offset
        return (moved[:, :-1] - batch.frames[:, 1:]).square().mean()

    def validation_step(self, batch: Window, batch_idx: int) -> None:
        self.evaluated.append(batch.frames.shape)

    test_step = predict_step = validation_step

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.parameters(), lr=0.01)


def trainer_of(folder, *callbacks, **options) -> Trainer:
    known = {
        "accelerator": "cpu", "logger": False, "enable_progress_bar": False, "enable_model_summary": False,
        "default_root_dir": folder, "limit_val_batches": 0, "enable_checkpointing": bool(callbacks), "max_epochs": -1,
    }  # fmt: skip
    return Trainer(callbacks=list(callbacks), **(known | options))


def module_of(folder, **options) -> TrajectoryDataModule:
    return TrajectoryDataModule(**({"path": str(folder), "horizon": 3, "batch_size": 2, "buffer_size": 2} | options))


VALIDATING = {"val_check_interval": 3, "check_val_every_n_epoch": None, "limit_val_batches": 1.0}
SETTINGS = [  # options of the trainer, the step after which it stops, and whether it goes on from last.ckpt
    ({}, 3, True),
    ({"limit_train_batches": 5, "accumulate_grad_batches": 2}, 3, True),
    (VALIDATING, 5, False),
    *(
        pytest.param(*values, marks=pytest.mark.slow)
        for values in (
            ({"accumulate_grad_batches": 2}, 5, True),
            ({"limit_train_batches": 5}, 6, False),
            ({"val_check_interval": 2, "limit_train_batches": 6, "limit_val_batches": 1.0}, 6, True),
        )
    ),
]


@pytest.mark.filterwarnings("ignore:Be aware that when using `ckpt_path`", "ignore:.fit.ckpt_path=")
class TestResuming:
    @pytest.mark.parametrize(("options", "stop", "last"), SETTINGS)
    def test_resumed_training_sees_the_same_batches(self, make_dataset, tmp_path, options, stop, last):
        folder = make_dataset(train=TRAIN)
        straight, first, second = Recorder(), Recorder(), Recorder()
        trainer_of(tmp_path, max_steps=11, **options).fit(straight, datamodule=module_of(folder))
        name, saved = "{step}", tmp_path / "saved" / ("last.ckpt" if last else f"step={stop}.ckpt")
        saving = ModelCheckpoint(saved.parent, name, save_top_k=-1, every_n_train_steps=1, save_last=last)
        trainer_of(tmp_path, saving, max_steps=stop, **options).fit(first, datamodule=module_of(folder))
        trainer_of(tmp_path, max_steps=11, **options).fit(second, datamodule=module_of(folder), ckpt_path=saved)
        assert first.seen + second.seen == straight.seen
        assert len(straight.seen) >= 11
        assert torch.equal(second.offset, straight.offset)

    def test_an_interrupted_batch_is_repeated_and_a_new_run_starts_at_the_beginning(self, make_dataset, tmp_path):
        module = module_of(make_dataset(train=TRAIN))
        straight, broken, resumed = Recorder(), Recorder(fail_at=4), Recorder()
        trainer_of(tmp_path, max_steps=9).fit(straight, datamodule=module)
        with pytest.raises(RuntimeError, match="interrupted"):
            trainer_of(tmp_path, OnExceptionCheckpoint(tmp_path, "broken"), max_steps=9).fit(broken, datamodule=module)
        saved = tmp_path / "broken.ckpt"
        trainer_of(tmp_path, max_steps=9).fit(resumed, datamodule=module, ckpt_path=saved)
        assert broken.seen + resumed.seen == straight.seen
        assert torch.equal(resumed.offset, straight.offset)


@pytest.mark.filterwarnings("ignore:predict returned None")
def test_every_stage_runs(make_dataset, tmp_path):
    module, model = module_of(make_dataset(train=TRAIN)), Recorder()
    trainer = trainer_of(tmp_path, max_steps=2, limit_val_batches=1.0)
    trainer.fit(model, datamodule=module)
    model.evaluated.clear()
    for stage in (trainer.validate, trainer.test, trainer.predict):
        stage(model, datamodule=module)
    whole = [torch.Size((2, 12, 5, 2)), torch.Size((2, 12, 6, 2)), torch.Size((1, 15, 4, 2))]
    assert model.evaluated == whole + whole[1:]


def as_rank(module: TrajectoryDataModule, rank: int, world: int, device: str = "cpu") -> TrajectoryDataModule:
    progress = SimpleNamespace(total=SimpleNamespace(processed=0))
    loop = SimpleNamespace(epoch_loop=SimpleNamespace(batch_progress=progress))
    strategy = SimpleNamespace(root_device=torch.device(device))
    module.trainer = SimpleNamespace(  # type: ignore[assignment]
        global_rank=rank, world_size=world, fit_loop=loop, strategy=strategy
    )
    return module


class TestEvaluation:
    @pytest.mark.parametrize(("world", "batch_size"), [(1, 2), (2, 8), (3, 1)])
    def test_each_trajectory_is_on_exactly_one_rank(self, make_dataset, world, batch_size):
        sizes = ((12, 5), (15, 4), (12, 6), (12, 7), (15, 3), (13, 2), (12, 3))
        folder, seen = make_dataset(test=sizes), Counter[int]()
        for rank in range(world):
            module = as_rank(module_of(folder, eval_batch_size=batch_size), rank, world)
            loader, split = module.test_dataloader(), module.data_source.recordings("test").split
            assert len(loader) == len(loader.batches) >= 1
            for batch, window in zip(loader.batches, loader, strict=True):
                assert len(batch) == len(window.frames) <= batch_size
                seen.update(batch)
                for row, index in enumerate(batch):
                    truth = torch.from_numpy(split.read(index).position)
                    assert torch.equal(window.frames[row, :, window.mask[row]], truth)
        assert seen == Counter(range(7))

    def test_similar_sizes_share_a_batch_and_single_ones_keep_their_order(self, make_dataset):
        folder = make_dataset(test=((12, 3), (12, 40), (12, 4), (12, 41), (12, 5)))
        loader = module_of(folder, eval_batch_size=2).test_dataloader()
        assert loader.batches == ((0, 2), (1, 4), (3,))
        assert module_of(folder, eval_batch_size=1).test_dataloader().batches == ((0,), (1,), (2,), (3,), (4,))

    def test_a_rank_without_trajectories_has_one_batch_of_none(self, make_dataset):
        loader = as_rank(module_of(make_dataset()), 2, 3).val_dataloader()
        (window,) = loader
        assert loader.batches == ((),)
        assert window.frames.shape[:2] == (0, 12)


def test_ranks_train_on_different_windows(make_dataset):
    loaders = [as_rank(module_of(make_dataset(train=TRAIN)), rank, 2).train_dataloader() for rank in (0, 1)]
    batches = [[window.frames.sum() for window in islice(loader, 6)] for loader in loaders]
    assert not set(map(float, batches[0])) & set(map(float, batches[1]))


@pytest.mark.parametrize(
    ("device", "free", "held_on"), [("cuda", 10**9, "cuda"), ("cuda", 0, "cpu"), ("cpu", 0, "cpu")]
)
def test_on_a_gpu_the_buffer_is_there_if_it_fits_or_else_batches_are_pinned_and_copied_without_blocking(
    make_dataset, monkeypatch, device, free, held_on
):
    pinned, copied = [], []
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda _: (free, 2 * free))
    monkeypatch.setattr(Window, "pin_memory", lambda window: pinned.append(window) or window)
    module = as_rank(module_of(make_dataset()), 0, 1, device)
    source, plan = module.data_source.training_data(5, module.reading, batch_size=2, buffer_size=2, passes=1, seed=0)
    assert module.buffer_device(source, plan).type == held_on
    if held_on == "cpu":
        windows = [*islice(module.train_dataloader(), 2), next(iter(module.val_dataloader()))]
        assert [any(window is call for call in pinned) for window in windows] == [device == "cuda"] * 3
        monkeypatch.setattr(Window, "to", lambda window, *args, **options: copied.append((args, options)) or window)
        assert module.transfer_batch_to_device(windows[0], torch.device(device), 0) is windows[0]
        assert copied == [((torch.device(device),), {"non_blocking": device == "cuda"})]


@pytest.mark.usefixtures("home")
def test_an_embedded_dataset_is_simulated_on_first_use(tmp_path):
    options = {"counts": {"train": 2, "valid": 1, "test": 1}, "frames": 6}
    module, model = module_of(None, path=None, name="goop", generate=options), Recorder()
    trainer_of(tmp_path, max_steps=2).fit(model, datamodule=module)
    assert len(model.seen) == 2
    assert len(module.data_source.recordings("train")) == 2


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({}, "Neither data.path nor data.name"),
        ({"path": "???"}, "data.path is not set.*give --data.path FOLDER"),
        ({"path": "a", "horizon": 0}, "horizon = 0"),
        ({"path": "a", "limit_eval": 0}, "limit_eval = 0"),
        ({"path": "a", "source": "simulate"}, "needs the `name` .*--data.source disk"),
        (
            {"name": "WaterRamps", "source": "hub", "generate": {"frames": 3}},
            "generate cannot be combined with the published dataset WaterRamps",
        ),
        (
            {"name": "goop", "family": "deepmind"},
            "family cannot be combined with the simulated dataset goop; leave it out: --data.family null",
        ),
        (
            {"name": "goop", "generate": {"train": 4, "count": 3}},
            r"'count', 'train' is not an option.*generate: {counts: {train: 4, ",
        ),
    ],
)
def test_contradictory_options_are_refused(options, named):
    with pytest.raises(ConfigError, match=named):
        TrajectoryDataModule(**options).prepare_data()


def test_a_path_replaces_a_name(make_dataset):
    module = module_of(make_dataset(), name="waterramps", generate={"frames": 3})
    assert module.description == "dataset"
    assert module.scene.materials == ("goop",)
    assert TrajectoryDataModule(path="???", name="goop").description == "goop, simulated by nmpm"


def test_trajectories_too_short_for_a_window_are_left_out_and_counted(make_dataset):
    folder = make_dataset(train=TRAIN, valid=((2, 5), (6, 4), (5, 3)))
    with pytest.warns(UserWarning, match=r"train.h5: 3 of 5 trajectories have fewer than 10 frames, a training window"):
        loader = module_of(folder, horizon=8).train_dataloader()
    provider = loader.buffer.provider
    assert [provider.indices[number] for number in loader.buffer.plan.members(0)] == [0, 2]
    assert loader.buffer.plan.frames == (12, 14)
    with pytest.warns(UserWarning, match=r"valid.h5: 1 of 3 trajectories have fewer than 3 frames, an evaluation"):
        loader = module_of(folder).val_dataloader()
    assert sorted(index for batch in loader.batches for index in batch) == [1, 2]
    assert {window.frames.shape[1:3] for window in loader} == {(5, 3), (6, 4)}


def test_files_that_do_not_suffice_are_named(make_dataset):
    folder = make_dataset(train=TRAIN, valid=((2, 5),))
    with pytest.raises(DataError, match=r"its longest trajectory has 14 frames, a training window needs 22.*horizon"):
        module_of(folder, horizon=20).train_dataloader()
    with pytest.raises(DataError, match="its longest trajectory has 2 frames, an evaluation needs 3"):
        module_of(folder).val_dataloader()
    (folder / "valid.h5").rename(folder / "validation.h5")
    with pytest.raises(DataError, match=r"no valid.h5 there.*Rename validation.h5 to valid.h5"):
        module_of(folder).val_dataloader()
    assert any("Rename validation.h5" in finding.sentence for finding in inspect(FolderSource(folder)).findings)


@pytest.mark.usefixtures("home")
def test_what_type_ids_tell_needs_no_statement_and_others_can_be_named(make_dataset):
    folder = make_dataset(train=(), valid=(), statics=2)
    keys = json.loads((folder / METADATA_FILE).read_text())
    del keys["particle_types"], keys["static_types"]
    (folder / METADATA_FILE).write_text(json.dumps(keys))
    source = FolderSource(folder)
    assert (source.scene.materials, source.scene.obstacles) == (("goop",), True)
    assert source.metadata.particle_types[7] == "goop"
    named = FolderSource(folder, Options(types={7: "slime", 3: "wall"}))
    assert (named.scene.materials, named.scene.obstacles) == (("slime",), True)
    with pytest.raises(DataError, match=r"no train\.h5 there \(beside it: test\.h5\)"):
        source.split("train")
    converted = FolderSource(folder, Options(smooth=5))
    assert converted.scene.materials == ("goop",)
    with pytest.raises(DataError, match=r"dataset: no trajectories for train, only for test\. Files or folders"):
        converted.split("train")
