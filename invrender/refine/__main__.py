"""`python -m invrender.refine CAPTURE -o OUT`, the same as `invrender refine`."""

import sys

from invrender.cli.main import main

sys.exit(main(["refine", *sys.argv[1:]]))
