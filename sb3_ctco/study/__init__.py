"""The frequency study: algorithms × tasks × interaction rates × seeds, from a preset file to a figure.

``sb3-ctco study --help`` is its command line.
"""
