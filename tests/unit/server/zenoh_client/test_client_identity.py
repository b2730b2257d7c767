"""The id of a client, and the queriers that send its requests. No server."""

import threading

import zenoh
from solidcloud.server.zenoh_client.client_identity import ClientIdentity
from solidcloud.server.zenoh_common.zenoh_settings import session_config


def test_an_id_is_closed_while_other_threads_send_queries_under_it():
    """One thread takes a new id, as a session's does; others still send under the old one."""
    with zenoh.open(session_config()) as session:
        for _ in range(20):
            identity, closed, failures = ClientIdentity(session, "hall", 1.0), threading.Event(), []

            def send(identity=identity, closed=closed, failures=failures):
                while not closed.is_set():
                    try:
                        identity.queriers["collide"].get()
                    except Exception as error:
                        failures.append(error)
                        return

            threads = [threading.Thread(target=send) for _ in range(2)]
            for thread in threads:
                thread.start()
            try:
                identity.close()
            finally:
                closed.set()
                for thread in threads:
                    thread.join()
            assert not failures
