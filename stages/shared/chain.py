"""The chain of stages: each reads what those before it made. COLMAP, the baseline, stands beside it."""

BEFORE = ("inspect", "flow")
REPEATED = ("motion", "segment", "ba")
"""What `rounds` repeat, each with the poses of the round before."""
AFTER = ("scene", "control", "gaussians", "render", "evaluate")
STAGES = (*BEFORE, *REPEATED, *AFTER)
MEASURED = ("inspect", "colmap", *STAGES[1:-1])
"""Every stage up to the evaluation, which reports what they cost."""
