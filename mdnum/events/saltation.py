# shim
import sys

import mdnum.numerics.saltation

sys.modules[__name__] = sys.modules["mdnum.numerics.saltation"]
