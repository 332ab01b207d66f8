"""What the endpoint families share: the way from a thread to the loop, calls, interest, first messages, complaints."""
