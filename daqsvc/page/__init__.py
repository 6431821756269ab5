"""The page: what an engineer looks at in a browser. Its own process beside the service.

`source` asks the service over its control socket, `machine_live` keeps what it tells, `views` turn that into
figures and text, `server` hands both to browsers.
"""
