"""Which effects are found, and where none is: a confusion table over scenes with one effect at five strengths.

    python -m benchmarks.effect_confusion /tmp/effects docs/effects.md         # and yard: on this base alone
    python -m benchmarks.effect_confusion /tmp/effects docs/effects.md grove medium  # medium strengths and no effect

The scenes (benchmarks/effect_cases.py) are rendered and solved by the pipeline itself, up to scene.json, with the
preset fast; what is finished in the folder is not made again. The report is a page of Markdown, whose last section,
NOTES, is written by hand and stays.
"""

import subprocess
import sys
from pathlib import Path

import numpy as np
import yaml

from benchmarks.effect_cases import BASES, EFFECTS, MEDIUM, REPO, Case, Effect, cases
from stages.report.provenance import about_run
from stages.shared.artifacts import read_json

RIGHT_SHARE = 0.95
NOTES = "## What the tables say"
ALONE = "medium"
"""Leaves out all other strengths than this one."""
BATCH = 8
"""Scenes that are planned at once: Snakemake may do the same step of all of them before it begins the next."""


def solve(folder: Path, wanted: list[Case]) -> None:
    """Render and solve the scenes in a folder, up to scene.json; those that fail are left out of the tables."""
    (folder / "scenes").mkdir(parents=True, exist_ok=True)
    for case in wanted:
        path = folder / f"scenes/{case.name}.yaml"
        text = yaml.safe_dump(case.scene(), sort_keys=False)
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")
    (folder / "effects.yaml").write_text(
        yaml.safe_dump({"scenes": [f"scenes/{case.name}.yaml" for case in wanted], "preset": "fast"}), encoding="utf-8"
    )
    targets = [f"results/simulated/{case.name}/scene.json" for case in wanted]
    command = [sys.executable, "-m", "snakemake", *targets, "--snakefile", REPO / "Snakefile", "--directory", folder]
    command += ["--configfile", folder / "effects.yaml", "--keep-going", "--quiet", "--rerun-triggers", "mtime"]
    # Waking once a second for every job that has ended, the scheduler took a third of the time.
    command += ["--cores", 2, "--max-threads", 1, "--max-jobs-per-timespan", "1000/1m"]
    subprocess.run([*map(str, command)], check=False)


def decisions(folder: Path, case: Case) -> dict[str, bool] | None:
    """Whether each effect was found in a scene; None if it was not solved."""
    path = folder / f"results/simulated/{case.name}/scene.json"
    if not path.exists():
        return None
    content = read_json(path)
    return {name: bool(content[effect.key]["needed"]) for name, effect in EFFECTS.items() if effect.key in content}


Verdicts = list[tuple[Case, dict[str, bool]]]


def strength_table(verdicts: Verdicts) -> list[str]:
    """A row per effect: in how many of the scenes with it alone it was found, by strength, and where that flips."""
    lines = [
        "| effect | unit | found at strength: scenes of all | found in all run from |",
        "| --- | --- | --- | --- |",
    ]
    for name, effect in EFFECTS.items():
        found = {s: [v[name] for case, v in verdicts if case.strengths == {name: s}] for s in effect.strengths}
        found = {strength: of for strength, of in found.items() if of}
        words = ", ".join(f"{strength:g}: {sum(of)}/{len(of)}" for strength, of in found.items())
        sure = [s for n, s in enumerate(found) if all(map(all, list(found.values())[n:]))]
        where = f"{sure[0]:g}" if sure else "never" if words else "not run"
        lines.append(f"| {name} | {effect.unit} | {words or '-'} | {where} |")
    return lines


def confusion_table(verdicts: Verdicts) -> list[str]:
    """Rows: what a scene has, alone and at any strength. Columns: in how many of them each effect was found."""
    lines = ["| scenes with | scenes | " + " | ".join(EFFECTS) + " |", "| --- |" + " ---: |" * (len(EFFECTS) + 1)]
    for row in [None, *EFFECTS]:
        of = [v for case, v in verdicts if list(case.strengths) == ([row] if row else [])]
        if not of:
            continue
        cells = [
            f"**{sum(v[name] for v in of)}**" if name == row else str(sum(v[name] for v in of)) for name in EFFECTS
        ]
        lines.append(f"| {row or 'none of them'} | {len(of)} | " + " | ".join(cells) + " |")
    return lines


def pair_table(verdicts: Verdicts) -> list[str]:
    """A row per scene with two effects: what was found, and whether that is right."""
    lines = ["| scene with | on | found | missed | false |", "| --- | --- | --- | --- | --- |"]
    for case, verdict in verdicts:
        if len(case.strengths) == 2:
            found = {name for name, was in verdict.items() if was}
            parts = (found & case.effects, case.effects - found, found - case.effects)
            words = " | ".join(", ".join(sorted(part)) or "-" for part in parts)
            lines.append(f"| {' and '.join(case.strengths)} | {case.base.stem} | {words} |")
    return lines


def right_table(verdicts: Verdicts) -> list[str]:
    """A row per effect: how many decisions are right at medium strength and more, and where the effect is absent."""
    lines = ["| effect | found where it is | not found where it is not | right |", "| --- | ---: | ---: | ---: |"]
    for name, effect in EFFECTS.items():
        there = [v[name] for case, v in verdicts if name in case.effects and _is_medium(case, name, effect)]
        absent = [not v[name] for case, v in verdicts if name not in case.effects]
        words = "not run"
        if there and absent:
            right = (np.mean(there) + np.mean(absent)) / 2
            words = f"{right:.0%}" if right >= RIGHT_SHARE else f"{right:.0%} (goal {RIGHT_SHARE:.0%})"
        lines.append(f"| {name} | {sum(there)}/{len(there)} | {sum(absent)}/{len(absent)} | {words} |")
    return lines


def _is_medium(case: Case, name: str, effect: Effect) -> bool:
    """Whether a scene has an effect at medium strength or more; where another effect implies it, it does."""
    return name not in case.strengths or abs(case.strengths[name]) >= abs(effect.strengths[MEDIUM])


def _turn(case: Case) -> int:
    """Medium strengths are solved first, weak ones last: what decides, if a run is stopped early."""
    ranks = [np.sign(EFFECTS[name].strengths.index(value) - MEDIUM) for name, value in case.strengths.items()]
    return {0: 0, 1: 1, -1: 2}[int(min(ranks, default=0))]


def page(verdicts: Verdicts, unsolved: list[str], about: str) -> str:
    """The page docs/effects.md."""
    parts = {
        "Right decisions": (
            "Where an effect is, at medium strength or more, and where it is not. Right: the mean of both shares.",
            right_table(verdicts),
        ),
        "Strengths": ("The third of each five strengths is the medium one.", strength_table(verdicts)),
        "Confusion": (
            "Scenes with one effect, at any of its strengths, and how often each effect was found in them. What stands"
            " beside the diagonal is a false alarm, but for movers that bend, which move as well.",
            confusion_table(verdicts),
        ),
        "Pairs": ("Two effects at once, both at medium strength.", pair_table(verdicts)),
    }
    lines = ["# Effects: found where they are, and only there", "", about]
    for title, (words, table) in parts.items():
        lines += ["", f"## {title}", "", words, "", *table]
    if unsolved:
        lines += ["", f"Not solved: {', '.join(unsolved)}."]
    return "\n".join(lines) + "\n"


def main(folder: Path, output: Path, *names: str) -> None:
    """Render, solve, judge, and write the page, on the base scenes of these names, or on all.

    With ALONE among the names, strengths other than the medium one are left out.
    """
    named = set(names) - {ALONE}
    bases = [base for base in BASES if base.stem in (named or {base.stem})]
    wanted = [case for case in cases(bases) if ALONE not in names or _turn(case) == 0]
    ordered = sorted(wanted, key=_turn)
    for first in range(0, len(ordered), BATCH):
        solve(folder, ordered[first : first + BATCH])
    found = [(case, decisions(folder, case)) for case in wanted]
    run = about_run()
    about = (
        "Written by `python -m benchmarks.effect_confusion`, but for the last section."
        f" {run['written']}, commit {run['commit']}, preset `fast`;"
        f" base scenes {', '.join(base.stem for base in bases)}, of 20 frames of 384 x 216 px"
        f"{', at medium strength alone' if ALONE in names else ''}."
    )
    unsolved = [case.name for case, verdict in found if verdict is None]
    text = page([(case, verdict) for case, verdict in found if verdict is not None], unsolved, about)
    before = output.read_text(encoding="utf-8") if output.exists() else ""
    text += f"\n{NOTES}{before.split(NOTES)[1]}" if NOTES in before else ""
    print(text)
    output.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), *sys.argv[3:])
