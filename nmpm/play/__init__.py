"""The emulator live in a browser: `nmpm play`.

`session` applies what a page sends to the scene of `world` and answers with frames; `server` carries both.
"""
