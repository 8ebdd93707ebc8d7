"""What colours tell about the light."""

DARK, BRIGHT = 0.06, 0.94
"""Colours in 0..1 outside this range are clipped or mostly noise: a channel there says nothing about light."""
LIGHT_CHANGES = 8 / 255
"""Colours in 0..1 of one place at rest that differ by more are lit differently: less is noise, or misplaced texture."""
