"""Scenes, and what else it takes, to train the network that refines masks of motion."""
