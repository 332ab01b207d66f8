"""What the endpoint families share.

handover    from a middleware's thread to the event loop
queue       what waits, bounded in count and bytes
interest    subscriptions that take only what somebody wants
stream      streams that come in; first: their first messages, which wait for their readers
calls       service calls that wait for answers, and those that are being answered
saying      what is said once, or once until it is over
ages        how old topics of other sites are, as topics of their own
held        subscriptions that keep refused messages
viewed      what is asked where a client has nothing on demand
"""
