# shim
import sys

import mdnum.numerics.reductions

sys.modules[__name__] = sys.modules["mdnum.numerics.reductions"]
