"""The API: accepts drives, records what is asked, and serves results.

It opens no image and never imports the engine.
"""
