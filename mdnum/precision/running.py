# shim
import sys

import mdnum.numerics.running

sys.modules[__name__] = sys.modules["mdnum.numerics.running"]
