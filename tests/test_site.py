"""The documentation: it builds without a warning and without the network, and its links hold."""

import html
import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from nmpm import Zoo
from nmpm._support.messages import install
from tests.conftest import wait_until

ROOT = Path(__file__).parent.parent
PAGES = [
    path
    for pattern in ("README.md", "CHANGELOG.md", "docs/**/*.md", "zoo/**/*.md", "benchmarks/**/*.md")
    for path in sorted(ROOT.glob(pattern))
]
FENCED = re.compile(r"^ *```.*?^ *```$", flags=re.DOTALL | re.MULTILINE)
CODE = re.compile(r"`[^`\n]*`")
FETCHED = re.compile(r"<(?:script|img|iframe)\b[^>]*\bsrc=\"?(?:https?:)?//|<link\b[^>]*\bhref=\"?(?:https?:)?//")
LINK = re.compile(r"\]\(([^)\s]+)\)")
if not (ROOT / "mkdocs.yml").is_file() or not (ROOT / "notebooks").is_dir():
    pytest.skip("the documentation is not complete in this distribution", allow_module_level=True)


def anchors(path: Path) -> set[str]:
    """Anchors of the headings of a Markdown file."""
    headings = re.findall(r"^#+ (.+)$", FENCED.sub("", path.read_text("utf-8")), flags=re.MULTILINE)
    kept = [re.sub(r"[^\w\s-]", "", heading.lower()).strip() for heading in headings]
    return {re.sub(r"\s", "-", heading) for heading in kept}


def load_hook(name: str):
    """A hook of the site, as MkDocs loads it."""
    pytest.importorskip("mkdocs", reason=install("docs"))
    spec = importlib.util.spec_from_file_location(f"docs_hook_{name}", ROOT / "docs" / "hooks" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_within_the_repository_hold(page):
    """As on a page that shows the repository's files; whether they hold in the site, MkDocs checks."""
    text = CODE.sub("", FENCED.sub("", page.read_text("utf-8")))
    for target in LINK.findall(text):
        if re.match(r"\w+:", target):
            continue
        name, _, anchor = target.partition("#")
        found = page.parent / name if name else page
        assert found.exists(), target
        assert not anchor or anchor in anchors(found), target


def build(folder: Path) -> None:
    """Builds the site; warnings are errors."""
    paths = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {"NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": os.pathsep.join(paths), "COLUMNS": "40"}
    environment["NMPM_GALLERY_FRAMES"] = "8"
    run = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)],
        cwd=ROOT,
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=570,
        check=False,
    )
    assert run.returncode == 0, run.stdout[-4000:]


@pytest.mark.timeout(600)
def test_the_site_builds_and_fetches_nothing(tmp_path):
    for package in ("mkdocs", "material", "mkdocstrings", "onnxscript"):
        pytest.importorskip(package, reason=f"{package} is not installed: {install('docs')}")
    build(tmp_path)
    pages = {path.relative_to(tmp_path).as_posix(): path.read_text("utf-8") for path in tmp_path.glob("**/*.html")}
    sources = {path.relative_to(ROOT / "docs") for path in (ROOT / "docs").glob("**/*.md")}
    assert pages.keys() >= {path.with_suffix(".html").as_posix() for path in sources}
    assert pages.keys() >= {"index.html", "zoo/goop/index.html", "benchmarks/index.html"}
    for name, page in pages.items():
        assert FETCHED.search(page) is None, name
    assert all(f'id="nmpm.processors.{name}"' in pages["reference/nmpm.processors.html"] for name in ("UNet", "FNO"))
    assert all(
        (tmp_path / "gallery" / f"{name.replace('/', '-')}.html").stat().st_size < 1_500_000 for name in Zoo.list()
    )
    assert 'src="play/index.html"' in pages["play.html"]
    assert (tmp_path / "play" / "model.onnx").stat().st_size < 600_000
    assert 'src="quickstart-1.png"' in pages["notebooks/quickstart.html"]
    assert 'rel="next"' in pages["zoo/goop/index.html"]
    first = [pages["reference/nmpm.html"].index(f'id="nmpm.{name}"') for name in ("Zoo", "rollout", "Emulator")]
    assert first == sorted(first)
    commands = html.unescape(pages["reference/commands.html"])
    assert all(option in commands for option in ("--shard I/N", "--full", "--private", "usage: nmpm zoo match"))
    concepts = pages["concepts.html"]
    assert concepts.count("<svg") > 10
    assert "```math" not in concepts


def test_what_runs_where_is_the_table_of_the_engines():
    from nmpm.backends import ENGINES
    from nmpm.emulator.engines import rules

    page = load_hook("pages").engines_page()
    for rule in (*rules.MODELS, *rules.CALLS):
        marks = " | ".join("✓" if rule.feature in form.features else "" for form in ENGINES["numba"])
        assert f"| {rule.feature} | ✓ | {marks} |" in page
    assert all(f"- {rule.feature}" in page for rule in rules.RECORDINGS)


def test_help_does_not_depend_on_the_terminal(monkeypatch):
    pages = load_hook("pages")
    written = []
    for width in ("20", "200"):
        monkeypatch.setenv("COLUMNS", width)
        written.append(pages.commands_page())
    assert written[0] == written[1]
    assert os.environ["COLUMNS"] == "200"


def test_links_are_rewritten_to_their_place_in_the_site(tmp_path):
    links = load_hook("links")
    assert links.site_path(ROOT / "docs" / "howto" / "stress.md", ROOT / "docs") == "howto/stress.md"
    assert links.site_path(ROOT / "zoo" / "README.md", ROOT / "docs") == "zoo/README.md"


def test_players_of_the_gallery_are_loaded_in_view_and_released_outside(browser, tmp_path):
    """A browser drops the oldest of more than 16 contexts of WebGL: the page of 18 models had two that were black."""
    gallery = load_hook("gallery")
    names = [f"model{number}" for number in range(20)]
    (tmp_path / "gallery").mkdir()
    player = gallery.player("goop/fast", 4)
    for name in names:
        (tmp_path / "gallery" / f"{name}.html").write_text(player, "utf-8")
    (tmp_path / "gallery.html").write_text(f"<style>iframe {{height: 26rem}}</style>{gallery.page(names)}", "utf-8")
    page = browser.new_page(viewport={"width": 900, "height": 640})
    lost = []
    page.on("console", lambda message: lost.append(message.text) if "WebGL" in message.text else None)
    page.goto((tmp_path / "gallery.html").as_uri())
    for name in (*names, *names[::-1]):
        place = page.locator(f"iframe[title={name}]")
        place.scroll_into_view_if_needed()
        wait_until(page, f"document.querySelector('iframe[title={name}]').src.endsWith('{name}.html')")
        frame = place.element_handle().content_frame()
        frame.wait_for_url(f"**/{name}.html")
        wait_until(frame, "window.viewer && viewer.drawn > 0 && !viewer.drawing.gl.isContextLost()")
        loaded = page.evaluate("document.querySelectorAll('iframe[src^=gallery]').length")
        assert loaded <= 6
    assert not [text for text in lost if "Too many active WebGL contexts" in text]
    page.close()
