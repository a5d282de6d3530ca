# SPDX-License-Identifier: Apache-2.0
"""`python -m graphloc`: the command line."""

from graphloc.cli import main

if __name__ == "__main__":
    main()
