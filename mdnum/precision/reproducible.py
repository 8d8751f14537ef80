# shim
import sys

import mdnum.numerics.reproducible

sys.modules[__name__] = sys.modules["mdnum.numerics.reproducible"]
