"""Random faults at random moments on the kernel's CAN, judged by an independent listener:
`make chaos`.
"""
