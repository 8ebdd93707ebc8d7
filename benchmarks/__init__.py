"""Benchmarks: ratios against an alternative in the same run. Importing `stages` first sets the threads of torch."""

import stages as stages
