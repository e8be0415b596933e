"""MkDocs hook: a page on which visitors play a model in their own browser, by ONNX Runtime's WebAssembly.

The model is exported when the site is built; nothing is fetched then. The page loads a pinned ONNX Runtime when a
visitor presses Start, from the folder `onnxruntime_web` of mkdocs.yml, and takes no other file than the pinned one.
"""

from __future__ import annotations

import base64
import tempfile
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from torch import Tensor

from nmpm import Zoo
from nmpm.play.limits import SceneLimits
from nmpm.play.pictures import describe_played
from nmpm.viz.page import make_page, read_asset
from nmpm.zoo import Pretrained
from nmpm.zoo.export import FORMATS, Step, description

MODEL = "goop/fast"
SEED = 1
MOST = 4000  # particles
PACE = 2  # frames for each picture
VERSION = "1.30.0"
RUNTIME = (
    ("ort.wasm.bundle.min.mjs", "sha384-PLWz+nHEVHpjwBsO0YVdvQj6n5814Iv8E3b8FG0Rp/uIAtjFMCKOpP66iPzedrIG"),
    ("ort-wasm-simd-threaded.wasm", "sha384-vjBJ1z7qrhkTyYsNqKeF6c7N+nOJSU94czEo+tvZcu8G75JparGq9kB+kTnEUNVM"),
)
"""Files of `VERSION` of the npm package onnxruntime-web (its smallest build), with their subresource integrity."""


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the page, what it loads, and the page of the site that shows it."""
    folder = str(config.extra["onnxruntime_web"])
    for name, content in page_files(folder).items():
        files.append(File.generated(config, f"play/{name}", content=content))
    files.append(File.generated(config, "play.md", content=site_page(folder)))
    return files


def page_files(runtime: str) -> dict[str, str | bytes]:
    """The page and what it loads, by file name; `runtime` is the URL of the folder of ONNX Runtime's files."""
    model = Zoo.load(MODEL)
    page = make_page("onnx", described(model, runtime))
    return {"index.html": page, "worker.js": read_asset("worker.js"), "model.onnx": exported(model)}


def described(model: Pretrained, runtime: str) -> dict[str, Any]:
    """What the page's scripts read of the scene, its start and the runtime."""
    state, limits = model.example(SEED), SceneLimits(model)
    limits.most_particles = MOST
    return describe_played(
        model,
        limits,
        state.obstacle,
        title=f"{MODEL} in your browser",
        tools=("throw",),
        playing=True,
        pace=PACE,
        beside=False,
        start={"position": _base64(state.position), "velocity": _base64(state.velocity)},
        runtime={"folder": runtime, "files": RUNTIME},
        invitation=f"Start (loads ONNX Runtime, 14 MB, from {urlsplit(runtime).hostname or 'this site'})",
    )


def exported(model: Pretrained) -> bytes:
    """The model's step as ONNX."""
    step = Step(model.emulator)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.onnx"
        FORMATS["onnx"].write(step, description(step, MODEL, str(model.card["dataset"])), path)
        return path.read_bytes()


def site_page(runtime: str) -> str:
    """The site's page around it, as Markdown."""
    npm = f"https://www.npmjs.com/package/onnxruntime-web/v/{VERSION}"
    return (
        f"# Play\n\n[{MODEL}](zoo/{MODEL}/README.md) in your browser: press into the box and drag to throw a block."
        f' <a href="play/index.html">Open it alone</a>; `nmpm play` has more models, obstacles and the simulator.\n\n'
        f'<iframe src="play/index.html" title="{MODEL}" loading="lazy" class="player tall"></iframe>\n\n'
        "The whole call (p2g, network, g2p, constraints) is [exported](howto/export.md) to one file and runs in a"
        f" worker, on one thread. Start loads [onnxruntime-web {VERSION}]({npm}) from `{runtime}`, pinned by its hash."
        " The model gives 16 frames at once: a thrown block begins to move with the next call.\n"
    )


def _base64(values: Tensor) -> str:
    return base64.b64encode(values[0].numpy().astype("<f4").tobytes()).decode()
