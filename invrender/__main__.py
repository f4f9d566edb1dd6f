import sys

from invrender.cli.main import main

sys.exit(main())
