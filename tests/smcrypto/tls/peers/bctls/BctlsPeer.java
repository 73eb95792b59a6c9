/*
 * A peer for TLS 1.3 with SM algorithms (RFC 8998) made of bctls, for the tests and benchmarks of smcrypto.tls.
 *
 *   server SUITE -cert F -key F [-client-auth] [-alpn P]    prints "port N"; then, for every connection,
 *                                                           "done SUITE ALPN PEER" or "failed REASON"
 *   client SUITE HOST PORT -name HOST [-cert F -key F] [-alpn P] [-retry]    the same lines; -retry: no key share,
 *                                                           so that the server has to ask for one
 *
 * Certificates and keys are DER. The server sends back what it receives until the client closes; the client sends
 * its stdin, reads as many bytes, and prints them. No chain is checked, only that the peer holds the certificate's key.
 *
 *   benchmark SUITE -cert F -key F    prints "ready" once Java has compiled what is hot; then, for every line N of
 *                                     stdin, "done" after a connection that carried N mebibytes: both roles in this
 *                                     process, in two threads with pipes between them
 */

import java.io.IOException;
import java.io.InputStream;
import java.io.OutputStream;
import java.io.PipedInputStream;
import java.io.PipedOutputStream;
import java.net.InetAddress;
import java.net.ServerSocket;
import java.net.Socket;
import java.nio.charset.StandardCharsets;
import java.nio.file.Files;
import java.nio.file.Path;
import java.security.SecureRandom;
import java.util.HashMap;
import java.util.Hashtable;
import java.util.Map;
import java.util.Vector;

import org.bouncycastle.crypto.params.AsymmetricKeyParameter;
import org.bouncycastle.crypto.util.PrivateKeyFactory;
import org.bouncycastle.tls.*;
import org.bouncycastle.tls.crypto.TlsCertificate;
import org.bouncycastle.tls.crypto.TlsCryptoParameters;
import org.bouncycastle.tls.crypto.impl.bc.BcDefaultTlsCredentialedSigner;
import org.bouncycastle.tls.crypto.impl.bc.BcTlsCrypto;

public class BctlsPeer {
    static final BcTlsCrypto CRYPTO = new BcTlsCrypto(new SecureRandom());
    static final Map<String, Integer> SUITES =
        Map.of("TLS_SM4_GCM_SM3", CipherSuite.TLS_SM4_GCM_SM3, "TLS_SM4_CCM_SM3", CipherSuite.TLS_SM4_CCM_SM3);
    static final Map<String, String> OPTIONS = new HashMap<>();

    static <T> Vector<T> vector(T element) {
        Vector<T> made = new Vector<>();
        made.add(element);
        return made;
    }

    static Vector<?> protocols() {
        return OPTIONS.containsKey("-alpn") ? vector(ProtocolName.asUtf8Encoding(OPTIONS.get("-alpn"))) : null;
    }

    static TlsCredentials credentials(TlsContext context, byte[] requestContext) throws IOException {
        byte[] certificate = Files.readAllBytes(Path.of(OPTIONS.get("-cert")));
        AsymmetricKeyParameter key = PrivateKeyFactory.createKey(Files.readAllBytes(Path.of(OPTIONS.get("-key"))));
        CertificateEntry[] entries = {new CertificateEntry(CRYPTO.createCertificate(certificate), null)};
        return new BcDefaultTlsCredentialedSigner(
            new TlsCryptoParameters(context), CRYPTO, key,
            new Certificate(requestContext, entries), SignatureAndHashAlgorithm.sm2sig_sm3);
    }

    static String subject(Certificate chain) throws IOException {
        if (chain == null || chain.isEmpty()) {
            return "-";
        }
        TlsCertificate leaf = chain.getCertificateAt(0);
        return org.bouncycastle.asn1.x509.Certificate.getInstance(leaf.getEncoded()).getSubject().toString();
    }

    static String summary(TlsContext context, Certificate peer, String suite) throws IOException {
        ProtocolName chosen = context.getSecurityParametersConnection().getApplicationProtocol();
        return "done " + suite + " " + (chosen == null ? "-" : chosen.getUtf8Decoding()) + " " + subject(peer);
    }

    static class Client extends AbstractTlsClient {
        final String suite;
        String summary;

        Client(String suite) {
            super(CRYPTO);
            this.suite = suite;
        }

        @Override protected ProtocolVersion[] getSupportedVersions() {
            return ProtocolVersion.TLSv13.only();
        }

        @Override protected int[] getSupportedCipherSuites() {
            return new int[] {SUITES.get(suite)};
        }

        @Override protected Vector getSupportedGroups(Vector roles) {
            return vector(NamedGroup.curveSM2);
        }

        @Override protected Vector getSupportedSignatureAlgorithms() {
            return vector(SignatureAndHashAlgorithm.sm2sig_sm3);
        }

        @Override public Vector getEarlyKeyShareGroups() {  // without one the server must ask: HelloRetryRequest
            return OPTIONS.containsKey("-retry") ? new Vector() : vector(NamedGroup.curveSM2);
        }

        @Override protected Vector getProtocolNames() {
            return protocols();
        }

        @Override protected Vector getSNIServerNames() {
            return OPTIONS.containsKey("-name")
                ? vector(new ServerName(NameType.host_name, OPTIONS.get("-name").getBytes(StandardCharsets.US_ASCII)))
                : null;
        }

        @Override public TlsAuthentication getAuthentication() {
            return new TlsAuthentication() {
                public void notifyServerCertificate(TlsServerCertificate certificate) {
                }

                public TlsCredentials getClientCredentials(CertificateRequest request) throws IOException {
                    return OPTIONS.containsKey("-cert")
                        ? credentials(context, request.getCertificateRequestContext()) : null;
                }
            };
        }

        @Override public void notifyHandshakeComplete() throws IOException {
            summary = summary(context, context.getSecurityParametersConnection().getPeerCertificate(), suite);
        }
    }

    static class Server extends DefaultTlsServer {
        final String suite;
        String summary;

        Server(String suite) {
            super(CRYPTO);
            this.suite = suite;
        }

        @Override protected ProtocolVersion[] getSupportedVersions() {
            return ProtocolVersion.TLSv13.only();
        }

        @Override protected int[] getSupportedCipherSuites() {
            return new int[] {SUITES.get(suite)};
        }

        @Override public int[] getSupportedGroups() {
            return new int[] {NamedGroup.curveSM2};
        }

        @Override protected Vector getProtocolNames() {
            return protocols();
        }

        @Override public CertificateRequest getCertificateRequest() throws IOException {
            return OPTIONS.containsKey("-client-auth")
                ? new CertificateRequest(TlsUtils.EMPTY_BYTES, vector(SignatureAndHashAlgorithm.sm2sig_sm3), null, null)
                : null;
        }

        @Override public TlsCredentials getCredentials() throws IOException {
            return credentials(context, TlsUtils.EMPTY_BYTES);
        }

        @Override public void notifyClientCertificate(Certificate certificate) {
        }

        @Override public void notifyHandshakeComplete() throws IOException {
            summary = summary(context, context.getSecurityParametersConnection().getPeerCertificate(), suite);
        }
    }

    static void serve(String suite) throws IOException {
        ServerSocket listener = new ServerSocket(0, 5, InetAddress.getLoopbackAddress());
        System.out.println("port " + listener.getLocalPort());
        while (true) {
            try (Socket socket = listener.accept()) {
                TlsServerProtocol protocol = new TlsServerProtocol(socket.getInputStream(), socket.getOutputStream());
                Server server = new Server(suite);
                protocol.accept(server);
                System.out.println(server.summary);
                protocol.getInputStream().transferTo(protocol.getOutputStream());
                protocol.close();
            } catch (IOException | RuntimeException reason) {
                System.out.println("failed " + reason);
            }
        }
    }

    static void connect(String suite, String host, int port) throws IOException {
        try (Socket socket = new Socket(host, port)) {
            TlsClientProtocol protocol = new TlsClientProtocol(socket.getInputStream(), socket.getOutputStream());
            Client client = new Client(suite);
            protocol.connect(client);
            System.out.println(client.summary);
            byte[] sent = System.in.readAllBytes();
            Thread writer = new Thread(() -> {
                try {
                    protocol.getOutputStream().write(sent);
                } catch (IOException reason) {
                    System.out.println("failed " + reason);
                }
            });
            writer.start();
            System.out.write(protocol.getInputStream().readNBytes(sent.length));
            System.out.flush();
            protocol.close();
        } catch (IOException | RuntimeException reason) {
            System.out.println("failed " + reason);
        }
    }

    /** One connection between two threads: a handshake, then `megabytes` to the server. */
    static void both(String suite, int megabytes) throws Exception {
        PipedInputStream toServer = new PipedInputStream(1 << 17), toClient = new PipedInputStream(1 << 17);
        OutputStream fromClient = new PipedOutputStream(toServer), fromServer = new PipedOutputStream(toClient);
        long[] received = {0};
        Thread serving = new Thread(() -> {
            try {
                TlsServerProtocol protocol = new TlsServerProtocol(toServer, fromServer);
                protocol.accept(new Server(suite));
                byte[] buffer = new byte[1 << 16];
                InputStream input = protocol.getInputStream();
                for (int size; (size = input.read(buffer)) >= 0;) {
                    received[0] += size;
                }
            } catch (IOException reason) {
                // The pipe is gone before the answer to close_notify; whether all came is counted below.
            }
        });
        serving.start();
        TlsClientProtocol protocol = new TlsClientProtocol(toClient, fromClient);
        protocol.connect(new Client(suite));
        byte[] data = new byte[1 << 20];
        for (int i = 0; i < megabytes; i++) {
            protocol.getOutputStream().write(data);
        }
        protocol.close();
        serving.join();
        if (received[0] != (long) megabytes << 20) {
            throw new IOException("received " + received[0] + " bytes");
        }
    }

    public static void main(String[] arguments) throws Exception {
        String suite = arguments[1];
        for (int i = 2; i < arguments.length; i++) {
            if (arguments[i].startsWith("-")) {
                boolean flag = i + 1 == arguments.length || arguments[i + 1].startsWith("-");
                OPTIONS.put(arguments[i], flag ? "" : arguments[i + 1]);
            }
        }
        switch (arguments[0]) {
            case "server" -> serve(suite);
            case "client" -> connect(suite, arguments[2], Integer.parseInt(arguments[3]));
            default -> {
                for (int i = 0; i < 200; i++) {
                    both(suite, i % 10 == 0 ? 4 : 0);
                }
                System.out.println("ready");
                java.io.BufferedReader lines = new java.io.BufferedReader(new java.io.InputStreamReader(System.in));
                for (String line; (line = lines.readLine()) != null;) {
                    both(suite, Integer.parseInt(line));
                    System.out.println("done");
                }
            }
        }
    }
}
