"""Options of the simulator."""

from pydantic import Field

from stages.shared.options import MAX_SEED, Options


class SimulateOptions(Options):
    """Sintel-style scenes with exact truth (`dataset: simulated`)."""

    seed: int = Field(0, ge=0, le=MAX_SEED, description="seed of camera noise, textures and placement")
