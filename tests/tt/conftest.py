"""How many examples hypothesis tries, none of them timed: other work may share the machine."""

from hypothesis import settings

settings.register_profile("tt", deadline=None, max_examples=40)
settings.load_profile("tt")
