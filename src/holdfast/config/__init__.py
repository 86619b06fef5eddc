"""Configuration: from a file, or a name, to settings and a problem. Nothing that decides knows it.

:mod:`yaml_document` reads strictly, :mod:`source` says where a complaint is about, :mod:`loader`
makes the whole; :mod:`registry` finds problems by name and :mod:`user_code` users' own classes;
:mod:`source_digest` identifies the code that decides.
"""
