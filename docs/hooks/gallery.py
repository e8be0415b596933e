"""MkDocs hook: a page of the zoo's models, each with a player of a rollout that is computed when the site is built."""

from __future__ import annotations

import numpy as np
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from nmpm import Zoo
from nmpm.viz import LabelledTrajectories
from nmpm.viz.viewer import ViewerPage

IN_VIEW = """\
<script>
{
  const show = ({ isIntersecting, target }) => {
    const wanted = isIntersecting ? target.dataset.src : "about:blank";
    if (target.getAttribute("src") !== wanted) target.src = wanted;
  };
  const players = new IntersectionObserver((entries) => entries.forEach(show), { rootMargin: "200px" });
  document.querySelectorAll("iframe.player").forEach((player) => players.observe(player));
}
</script>"""
"""Loads players that are in view and unloads the others: browsers allow 16 contexts of WebGL, and a page has more."""
VALUES = 500_000  # coordinates of a page, which then has about a megabyte


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Adds the page and its players."""
    names, frames = Zoo.list(), int(config.extra["gallery_frames"])
    for name in names:
        files.append(File.generated(config, f"gallery/{_file(name)}", content=player(name, frames)))
    files.append(File.generated(config, "gallery.md", content=page(names)))
    return files


def page(names: list[str]) -> str:
    """The gallery, as Markdown."""
    parts = [
        f'## {name}\n\n[Its card](zoo/{name}/README.md); <a href="gallery/{_file(name)}">the player alone</a>\n\n'
        f'<iframe data-src="gallery/{_file(name)}" title="{name}" class="player"></iframe>'
        for name in names
    ]
    head = (
        "# Gallery\n\nA rollout of each model, from a scene of its own kind that it has not seen; `nmpm demo NAME` sets"
        "\nthe simulator beside it, `nmpm play NAME` lets you interfere; one model [plays in your browser](play.md)."
    )
    return "\n\n".join([head, *parts, IN_VIEW]) + "\n"


def player(name: str, frames: int) -> str:
    """The viewer's page of a rollout."""
    model = Zoo.load(name)
    state = model.example(seed=1)
    positions = np.concatenate([state.position[:, None], model.rollout(state, frames)], axis=1)[0]
    obstacle = None if state.obstacle is None else state.obstacle[0].numpy()
    trajectories = LabelledTrajectories.from_scene(
        model.scene, {name: positions}, state.material[0].numpy(), obstacle, title=name
    )
    return ViewerPage(trajectories, every=max(1, -(-positions.size // VALUES))).html


def _file(name: str) -> str:
    return f"{name.replace('/', '-')}.html"
