"""The leaderboards as one HTML file, as JSON and as CSV."""
