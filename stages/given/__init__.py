"""What the user knows and hands in: readers and checks of cameras, masks, depth and flow that are not estimated."""
