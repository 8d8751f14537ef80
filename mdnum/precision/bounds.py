# shim
import sys

import mdnum.numerics.rounding

sys.modules[__name__] = sys.modules["mdnum.numerics.rounding"]
