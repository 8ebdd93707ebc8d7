"""Benchmarks: ratios against an alternative in the same run. `stages` comes first: it sets the threads before torch."""

import stages as stages
