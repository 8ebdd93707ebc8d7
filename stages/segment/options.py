"""Options of mask refinement."""

from stages.shared.options import Options


class SegmentOptions(Options):
    """Motion prior to refined dynamic masks."""
