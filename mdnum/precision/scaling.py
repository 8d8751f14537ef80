# shim
import sys

import mdnum.numerics.scaling

sys.modules[__name__] = sys.modules["mdnum.numerics.scaling"]
