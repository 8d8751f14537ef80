# shim
from mdnum.numerics import *  # noqa: F403
