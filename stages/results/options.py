"""Options of the page of results."""

from pydantic import Field

from stages.shared.options import Options


class ResultsOptions(Options):
    """The page of results."""

    command: str = Field("", description="what made the results, as the page shall say it, e.g. make results")
