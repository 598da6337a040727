"""The work behind the commands: a source in, a folder of results out. Only this and the command line know
everything.
"""
