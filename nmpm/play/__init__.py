"""The emulator live in a browser: `nmpm play`.

`messages` reads what a page sends, `session` applies it and answers with frames, `server` carries both.
"""
