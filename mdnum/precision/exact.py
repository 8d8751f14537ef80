# shim
import sys

import mdnum.numerics.exact

sys.modules[__name__] = sys.modules["mdnum.numerics.exact"]
