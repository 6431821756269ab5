"""The reference in ``docs/reference``, from the code: keys, verbs, counters, metrics, messages, exit codes.

``python -m daqsvc.reference docs/reference`` writes the pages (``make reference``); with plugins of others
installed, theirs are in it, too. Whatever lacks words makes it fail, so that nothing public goes undescribed.
"""
