"""The description between the two ends of the loop: conventions, quantizers, frames, topics, links and time.

Nothing here knows a controller or a plant; both build on it and share nothing else. SPEC.md, beside this file, is the
normative text.
"""
