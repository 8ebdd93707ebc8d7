"""Options of the report."""

from pydantic import Field

from stages.shared.options import Options


class ReportOptions(Options):
    """The HTML report."""

    title: str = Field("motionsplat report", description="title of the page")
