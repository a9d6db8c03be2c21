"""The fixtures of networks."""

from networks import *  # noqa: F403 - what is imported here is a fixture of every test beside
