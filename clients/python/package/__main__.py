"""`python3 -m hardnessd`: prints events."""

import sys

from hardnessd import main

sys.exit(main())
