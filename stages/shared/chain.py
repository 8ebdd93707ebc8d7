"""The order of the stages: each reads results of earlier ones. COLMAP, the baseline, is not part of this chain."""

BEFORE = ("inspect", "flow", "lens")
REPEATED = ("motion", "segment", "ba")
"""Stages that `rounds` repeat, each round with the poses of the round before."""
AFTER = ("scene", "control", "gaussians", "render", "evaluate")
STAGES = (*BEFORE, *REPEATED, *AFTER)
MEASURED = ("inspect", "colmap", *STAGES[1:-1])
"""Stages whose cost the evaluation reports: all before it."""
