# shim
import sys

import mdnum.numerics.events

sys.modules[__name__] = sys.modules["mdnum.numerics.events"]
