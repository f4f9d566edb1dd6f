"""Materials, environments and simulated captures, and the bundled example."""

from pathlib import Path

EXAMPLE = Path(__file__).with_name("example")  # a capture with ground truth
