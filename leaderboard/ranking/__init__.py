"""The ranking: of each defended victim the worst attack of each cell counts, and flags cast doubt."""
