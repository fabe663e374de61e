"""The colours that mean the same in every recording, as red, green and blue from 0 to 255."""

from __future__ import annotations

Colour = tuple[int, int, int]

EGO: Colour = (86, 204, 122)
MEASURED: Colour = (122, 162, 247)
"""What was measured, before an attack."""
SHOWN: Colour = (255, 158, 74)
"""What the attack shows."""
GREY: Colour = (150, 152, 158)
