"""Run the command line: `python -m neurove_service.cli`."""

import sys

from neurove_service.cli.main import main

sys.exit(main())
