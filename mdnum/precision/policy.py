# shim
import sys

import mdnum.numerics.roles

sys.modules[__name__] = sys.modules["mdnum.numerics.roles"]
