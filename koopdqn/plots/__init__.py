"""The pictures of each command: all in one style."""

import os

# Pictures go to files alone, and matplotlib refuses to be imported where this names what it does not know.
os.environ["MPLBACKEND"] = "agg"
