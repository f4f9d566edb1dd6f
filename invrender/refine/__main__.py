"""`python -m invrender.refine CAPTURE -o OUT`, the same as `invrender refine`."""

import sys

from invrender.cli.main import run

run("refine", *sys.argv[1:])
