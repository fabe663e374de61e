"""What lets the server of worker processes start and end at once: importing this module does it, in the server only.

The server imports modules and forks. Looking for garbage takes a third of that time: workers turn it on again. Deleting all that
was imported takes a second, in which whatever reads the output of the command waits.
"""

import atexit
import gc
import os

gc.disable()
# The other hooks are called before this one, which was registered first. Workers end without hooks.
atexit.register(os._exit, 0)
