"""The tables of the thesis beside ours: chapter 3 (patches on a stop sign) and chapter 4 (driving policies)."""
