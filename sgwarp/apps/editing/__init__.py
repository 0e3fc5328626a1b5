"""Editing by language: selections and operations are plain data, a session applies, undoes and replays them."""
