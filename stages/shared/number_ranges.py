"""Numbers of frames as ranges, for lists and messages."""


def runs_of(numbers: list[int]) -> list[tuple[int, int]]:
    """The first and the last of every run of ascending numbers without gaps."""
    breaks = [k for k in range(1, len(numbers)) if numbers[k] != numbers[k - 1] + 1]
    starts, stops = [0, *breaks], [*breaks, len(numbers)]
    return [(numbers[start], numbers[stop - 1]) for start, stop in zip(starts, stops, strict=True)] if numbers else []


def number_ranges(numbers: list[int]) -> str:
    """Ascending numbers in words, as "3-5, 8"."""
    return ", ".join(f"{first}-{last}" if last > first else f"{first}" for first, last in runs_of(numbers))
