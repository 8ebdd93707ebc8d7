"""The report: complete, self-contained, honest about what is missing, and sound in a real browser."""

import csv
import html.parser
import json
import re
import shutil
import subprocess
from pathlib import Path

import comparison_tables
import cv2
import finished_run as run
import numpy as np
import pyarrow.parquet as pq
import pytest
from conftest import REPO
from PIL import Image

from stages.comparisons import made_under
from stages.report import __main__ as report_stage
from stages.report import embedding, overview, scene_pages
from stages.report.figures import STAGE_FIGURES
from stages.report.options import ReportOptions
from stages.report.sections import build_section
from stages.shared import charts
from stages.shared.artifacts import write_json, write_table

PUBLISHED = REPO / "workflow" / "resources" / "published.yaml"
SCENE = "<!DOCTYPE html><title>a scene</title><script>document.title += 1 < 2;</script>"
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class _Elements(html.parser.HTMLParser):
    """Every start tag with its attributes."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.found if name == tag]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report over one sequence with truth, one without, and one that was never evaluated."""
    root = tmp_path_factory.mktemp("report")
    folders = [run.finish(root, "wall"), run.finish(root / "blind", "blind_wall", truth=False)]
    (folders[0] / "gaussians" / "scene.html").write_text(SCENE)
    unfinished = root / "results" / "unfinished"
    shutil.copytree(folders[0], unfinished, ignore=shutil.ignore_patterns("eval", "renders", "masks"))
    content = json.loads((unfinished / "sequence.json").read_text())
    (unfinished / "sequence.json").write_text(json.dumps(content | {"name": "unfinished"}))
    effects = {"effects": {"fog": {"density": 0.1}}, "not_simulated": ["defocus"], "seconds": {"fog": 1.5}}
    write_json(root / "simulated" / "wall.json", {**effects, "calls": {"fog": 8}})
    stages = {"flow": 1, "motion": 2, "segment": 2, "ba": 2}
    made = made_under.of_runs(root / "results", [{"sequence": "wall", "stages": stages}])
    costs, grown = comparison_tables.write(root, made)
    report_stage.main(
        sequences=[*folders, unfinished],
        published_numbers=PUBLISHED,
        output=root / "index.html",
        tables=root / "tables",
        options=ReportOptions(title="a <title> & more"),
        manifests=root / "simulated",
        sweep=costs,
        growth=grown,
    )
    return root


@pytest.fixture(scope="module")
def page(results: Path) -> str:
    return (results / "index.html").read_text()


def test_page_is_one_self_contained_file(page: str) -> None:
    elements = _Elements(page)
    sources = [a.get("src") for a in elements.of("img")] + [a.get("href") for a in elements.of("a")]
    beside = [f"results/{name}/gaussians/scene.html" for name in ("wall", "unfinished")]  # they are inside too
    sources = [source for source in sources if source not in beside]
    assert all(str(source).startswith(("data:", "#")) for source in sources)
    assert all(str(a.get("href")).startswith("data:") for a in elements.of("link"))
    assert not any(a.get("src") for a in elements.of("script"))
    assert "a &lt;title&gt; &amp; more" in page
    assert len(page) < 5e6


def test_every_figure_has_words_and_every_link_a_target(page: str) -> None:
    elements = _Elements(page)
    images = elements.of("img")
    assert len(images) > 15
    assert all(len(str(image.get("alt"))) > 10 for image in images)
    targets = {attributes["id"] for _, attributes in elements.found if "id" in attributes}
    links = {str(a["href"])[1:] for a in elements.of("a") if str(a["href"]).startswith("#")}
    assert links <= targets


def test_every_table_is_also_csv_and_parquet(results: Path, page: str) -> None:
    names = {path.stem for path in (results / "tables").glob("*.csv")}
    assert {"poses", "poses_mean", "images", "masks", "checks", "time", "decisions", "options", "hashes"} <= names
    assert names == {path.stem for path in (results / "tables").glob("*.parquet")}
    shown = set(re.findall(r'<h3 id="(\w+)">', page))
    assert names <= shown
    with (results / "tables" / "poses.csv").open() as file:
        header, *rows = list(csv.reader(file))
    assert "ate [scene units]" in header
    table = pq.read_table(results / "tables" / "poses.parquet")
    assert len(rows) == table.num_rows == 10
    assert b"Sim(3)" in table.schema.metadata[b"protocol"]


def test_scenes_are_inside_while_there_is_room(results: Path, page: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the first screen; `unfinished` is a copy of `wall`, `blind_wall` has no scene."""
    assert page.index("Walk into the 4D scenes:") < page.index("<nav")
    folders = [results / "results" / "wall", results / "blind" / "blind_wall", results / "results" / "unfinished"]
    pages = scene_pages.find_scene_pages(folders, [], results / "report" / "index.html")
    assert [(found.name, found.link) for found in pages] == [
        (name, f"../results/{name}/gaussians/scene.html") for name in ("wall", "unfinished")
    ]
    assert [json.loads(found.content) for found in pages] == [SCENE, SCENE]
    monkeypatch.setattr(scene_pages, "ROOM_BYTES", scene_pages.REST_BYTES + len(pages[0].content) + 10)
    pages = scene_pages.find_scene_pages(folders, [], results / "index.html")
    assert [bool(found.content) for found in pages] == [True, False]


def test_failures_and_missing_parts_are_told(page: str) -> None:
    text = re.sub(r"<[^>]+>", " ", re.sub(r"data:[^\"]+", "", page))
    assert "wall, COLMAP incremental: failed (reconstruct: no model)" in text
    assert "wall, COLMAP global: partial (only 4 of 8 frames: errors over these)" in text
    assert "unfinished: not evaluated; it counts as failed" in text
    assert "No camera truth, hence no ATE or RPE: blind_wall" in text
    assert "no camera truth: no ATE, RPE or focal error" in text
    warned = "Round 1: an early warning. Last round: a warning; one more."
    assert f"wall: warnings of the bundle adjustment. {warned}" in text
    assert f"Warnings of the bundle adjustment. {warned}" in text
    assert "Warnings of the bundle adjustment. a warning; one more" in text  # of the sequence that was never evaluated
    assert "trajectories: no eval/trajectory.parquet; masks: no masks" in text
    assert "renders: no renders/test" in text


def test_true_poses_and_no_training_leave_no_curve(results: Path, tmp_path: Path) -> None:
    """`ba: {poses_from: truth}` adjusts nothing and `gaussians: {steps: 0}` trains nothing: their tables are empty."""
    folder = tmp_path / "wall"
    shutil.copytree(results / "results" / "wall", folder)
    columns = {"ba": ("iteration", "cost", "phase", "sigma_px"), "gaussians": ("step", "loss")}
    for stage, names in columns.items():
        write_table(folder / stage / "convergence.parquet", {name: [] for name in names})
    section = build_section(folder)
    assert "adjustment: no rows in ba/convergence.parquet" in section.missing
    assert "training: no rows in gaussians/convergence.parquet" in section.missing
    assert any("Error of every camera" in figure.title for figure in section.figures)


def test_comparisons_are_part_of_the_page(results: Path, page: str) -> None:
    text = re.sub(r"<[^>]+>", " ", re.sub(r"data:[^\"]+", "", page))
    assert "Effect of masks on pose error" in text
    assert "from the configured run (1.00 in 30 s) the next tenth costs" in text
    names = {path.stem for path in (results / "tables").glob("*.parquet")}
    assert {"sweep_presets", "sweep_knobs", "sweep_masks", "growth"} <= names
    methods = pq.read_table(results / "tables" / "poses.parquet").column("method").to_pylist()
    assert {"ours, fast", "ours, accurate"} <= set(methods)
    assert "ours, balanced" not in methods  # the configured run itself


@pytest.mark.parametrize(
    ("stage", "change", "told"),
    [
        ("flow", {"options": {"seed": 7}}, "flow.seed 0, now 7"),
        ("ba", {"code": "other"}, "ba by other code"),
    ],
)
def test_a_comparison_made_under_other_options_is_labelled_and_joins_no_table(
    results: Path, tmp_path: Path, stage: str, change: dict[str, object], told: str
) -> None:
    folder = tmp_path / "results" / "wall"
    shutil.copytree(results / "results" / "wall", folder)
    for path in folder.glob(f"**/stats/{stage}.json"):
        write_json(path, json.loads(path.read_text()) | change)
    tables = {"sweep": results / "sweep/costs.parquet", "growth": results / "scaling/growth.parquet"}
    output, written = tmp_path / "index.html", tmp_path / "tables"
    report_stage.main([folder], PUBLISHED, output, written, ReportOptions(), **tables)
    text = re.sub(r"<[^>]+>", " ", re.sub(r"data:[^\"]+", "", output.read_text()))
    assert text.count(f"Made under other options or code than the results above: {told}.") == 2
    assert "Presets (made under other options)" in text
    assert "Growth of cost (made under other options)" in text
    methods = pq.read_table(written / "poses.parquet").column("method").to_pylist()
    assert "ours" in methods
    assert not any(method.startswith("ours, fast") for method in methods)


def test_effects_say_what_ran_and_what_it_cost(results: Path) -> None:
    rows = pq.read_table(results / "tables" / "simulation.parquet").to_pylist()
    assert [(row["effect"], row["simulated"], row["seconds"]) for row in rows] == [
        ("fog", "yes", 1.5),
        ("defocus", "no", 0.0),
    ]
    decisions = pq.read_table(results / "tables" / "decisions.parquet").to_pylist()
    assert decisions[0]["evidence"] == "share 0.1"
    numbers = ("statistic", "low", "high", "threshold", "unit", "seconds")
    assert [decisions[0][name] for name in numbers] == [2.5, 2.0, 3.0, 0.15, "px", 0.5]
    assert {row["modelled"] for row in decisions} == {"yes", "no"}


def test_fourteen_sequences_stay_under_15_mb(tmp_path: Path) -> None:
    """Grain, which no codec likes: pictures keep their limits, and a section of such ones its share."""
    grain = np.clip(np.random.default_rng(0).normal(128, 25, (436, 1000, 3)), 0, 255).astype(np.uint8)
    wide = len(embedding.webp(grain))
    stage = len(embedding.webp(grain, embedding.STAGE_WIDTH_PX, embedding.STAGE_MAX_BYTES))
    frames = [Image.fromarray(np.roll(grain[:145, :340], 9 * k, axis=0)) for k in range(14)]
    frames[0].save(tmp_path / "fly.gif", save_all=True, append_images=frames[1:])
    moving = len(embedding.animation(tmp_path / "fly.gif"))
    chart = (
        len(charts.draw_lines({str(k): (range(50), grain[k, :50, 0]) for k in range(6)}, ("", ""), "012345")) * 4 / 3
    )
    section = 5 * wide + len(STAGE_FIGURES) * stage + moving + 8 * chart
    assert 14 * section + 1e6 < 15e6  # the overview and its charts take less than 1 MB
    smooth = cv2.GaussianBlur(grain, (0, 0), 20)
    assert len(embedding.webp(smooth)) < 0.5 * wide


def test_headline_without_any_result_says_so() -> None:
    rows: dict[str, list] = {kind: [] for kind in ("poses", "images", "masks", "checks", "time")}
    assert {tile.value for tile in overview.tiles(rows)} == {"n/a"}
    assert overview.problems(rows, ["lost"]) == ["lost: not evaluated; it counts as failed."]


PROBE = """<script>
addEventListener("load", () => {
  const heading = document.querySelector("#poses + .scroll th:nth-child(7) button");
  const column = () => [...heading.closest("table").tBodies[0].rows].map((row) => row.children[6].textContent.trim());
  heading.click(); const ascending = column(); heading.click();
  const outside = [...document.querySelectorAll("main *")].filter((element) =>
    !element.closest(".scroll") && element.getBoundingClientRect().right > innerWidth + 1);
  document.querySelectorAll("details").forEach((part) => { part.open = true; });
  const clipped = [...document.querySelectorAll(".scroll")].filter((box) => box.scrollWidth > box.clientWidth + 1);
  const loaded = performance.getEntriesByType("resource").map((entry) => entry.name);
  document.querySelector("[data-scene]").click();
  const scene = document.querySelector("dialog[open] iframe").srcdoc;
  document.querySelector("dialog").close();
  const broken = [...document.images].filter((image) => image.complete && !image.naturalWidth);
  parent.postMessage(JSON.stringify({ascending, descending: column(), width: innerWidth,
    scroll: document.documentElement.scrollWidth, outside: outside.map((element) => element.outerHTML.slice(0, 80)),
    clipped: clipped.map((box) => box.previousElementSibling.id),
    loaded: loaded.filter((name) => !name.startsWith("data:")), broken: broken.length, scene}), "*");
});
</script></body>"""
FRAME = """<body><script>addEventListener("message", (event) => { document.body.dataset.found = event.data; });</script>
<iframe src="probed.html" style="width: WIDTHpx; height: 900px; border: 0"></iframe></body>"""


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium found to look at the page with")
@pytest.mark.parametrize("width", [390, 1280])
def test_in_a_browser(results: Path, page: str, width: int) -> None:
    """Silent console, no request, tables that sort, and nothing wider than the screen."""
    (results / "probed.html").write_text(page.replace("</body>", PROBE).replace('loading="lazy"', ""))
    (results / f"frame{width}.html").write_text(FRAME.replace("WIDTH", str(width)))
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--virtual-time-budget=20000"]
    command = [str(CHROMIUM), *flags, "--window-size=1400,1000", "--dump-dom", str(results / f"frame{width}.html")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=True)
    assert [line for line in done.stderr.splitlines() if "CONSOLE" in line] == []
    body = next(attributes for tag, attributes in _Elements(done.stdout).found if tag == "body")
    found = json.loads(str(body["data-found"]))
    assert found["width"] == width
    assert found["scroll"] <= width
    assert found["outside"] == []
    assert found["clipped"] == [] or width < 1280  # a phone scrolls tables sideways, a desktop shows them whole
    assert found["loaded"] == []
    assert found["broken"] == 0
    assert found["scene"] == SCENE
    numbers = [float(value) for value in found["ascending"] if value != "n/a"]
    assert numbers == sorted(numbers)
    assert len(set(numbers)) > 1
    assert [value for value in found["descending"] if value != "n/a"] == [
        value for value in reversed(found["ascending"]) if value != "n/a"
    ]
    assert found["descending"][-1] == found["ascending"][-1] == "n/a"
