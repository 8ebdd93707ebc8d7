"""Options of the report."""

from pydantic import Field

from stages.shared.options import Options


class ReportOptions(Options):
    """Options of the HTML report."""

    title: str = Field("motionsplat report", description="title of the page")
