"""HTTP itself: request bodies, headers, ranges, digests, paging and the protocol of the server."""
