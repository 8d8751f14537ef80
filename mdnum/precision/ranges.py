# shim
import sys

import mdnum.numerics.formats

sys.modules[__name__] = sys.modules["mdnum.numerics.formats"]
