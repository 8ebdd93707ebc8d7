"""Options of the decision which effects a scene needs."""

from stages.shared.options import Options


class SceneOptions(Options):
    """Which effects the reconstruction simulates."""
