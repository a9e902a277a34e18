"""A room: other programs' input decks become scenes, and calibrated scenes become their cards."""
