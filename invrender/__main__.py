import sys

from invrender.cli import main

sys.exit(main())
