"""Options of the page of results."""

from pydantic import Field

from stages.shared.options import Options


class ResultsOptions(Options):
    """Options of the page of results."""

    command: str = Field("", description="the command that made the results, as the page states it, e.g. make results")
