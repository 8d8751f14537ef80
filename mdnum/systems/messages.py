# shim
import sys

sys.modules[__name__] = sys.modules["mdnum.systems.grammar"]
